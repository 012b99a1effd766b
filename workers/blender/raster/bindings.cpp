// The Python face: arrays in, arrays out. stickslip_blender.raster checks what users give.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>

#include "build_constants.hpp"
#include "raster.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class Scalar, class... Shape>
using Input = nb::ndarray<const Scalar, Shape..., nb::c_contig, nb::device::cpu>;
using Points = Input<double, nb::shape<-1, 3>>;
using Coordinates = Input<double, nb::shape<-1, 2>>;
using Triangles = Input<std::int32_t, nb::shape<-1, 3>>;
using Seen = Input<std::int32_t, nb::shape<-1, -1>>;
using Texels = Input<float, nb::shape<-1, -1, -1>>;
using WindowTuple = std::tuple<int, int, int, int>;

template <class Scalar, class Shape>
nb::ndarray<nb::numpy, Scalar, Shape, nb::c_contig> handed_over(std::vector<Scalar> values,
                                                                std::initializer_list<std::size_t> shape) {
  auto held = std::make_unique<std::vector<Scalar>>(std::move(values));
  Scalar* data = held->data();
  nb::capsule owner(held.release(), [](void* p) noexcept { delete static_cast<std::vector<Scalar>*>(p); });
  return {data, shape, owner};
}

template <class Item, class Array>
std::span<const Item> rows_of(const Array& array) {
  return {reinterpret_cast<const Item*>(array.data()), array.shape(0)};
}

void check(const Points& points, const Triangles& triangles, const WindowTuple& window, int grid) {
  const auto [left, top, width, height] = window;
  if (width < 1 || height < 1 || grid < 1 || grid > 64)
    throw std::invalid_argument("window and grid: sizes must be at least 1, and grid at most 64");
  for (std::size_t i = 0; i < points.shape(0); ++i) {
    if (!(points(i, 2) > 0.0))
      throw std::invalid_argument("points: depth must be above 0, and is not at point " + std::to_string(i));
  }
  const auto count = static_cast<std::int32_t>(points.shape(0));
  const std::int32_t* indices = triangles.data();
  if (std::any_of(indices, indices + triangles.size(), [=](std::int32_t v) { return v < 0 || v >= count; }))
    throw std::invalid_argument("triangles: indices must be from 0 to " + std::to_string(count - 1));
}

raster::Window as_window(const WindowTuple& window) {
  const auto [left, top, width, height] = window;
  return {left, top, width, height};
}

auto visible(const Points& points, const Triangles& triangles, const WindowTuple& window, int grid) {
  check(points, triangles, window, grid);
  const raster::Window part = as_window(window);
  std::vector<std::int32_t> seen;
  {
    nb::gil_scoped_release release;
    seen = raster::visible(rows_of<raster::Projected>(points), rows_of<raster::Triangle>(triangles), part, grid);
  }
  const auto height = static_cast<std::size_t>(part.height * grid), width = static_cast<std::size_t>(part.width * grid);
  return handed_over<std::int32_t, nb::shape<-1, -1>>(std::move(seen), {height, width});
}

auto albedo(const Seen& seen, const Points& points, const Triangles& triangles, const Coordinates& coordinates, int end,
            const Texels& texels, int count, const WindowTuple& window, int grid) {
  check(points, triangles, window, grid);
  const raster::Window part = as_window(window);
  const auto height = static_cast<std::size_t>(part.height), width = static_cast<std::size_t>(part.width);
  if (seen.shape(0) != height * grid || seen.shape(1) != width * grid)
    throw std::invalid_argument("seen: must have grid x grid samples a pixel of the window");
  const auto triangle_count = static_cast<std::int32_t>(triangles.shape(0));
  if (std::any_of(seen.data(), seen.data() + seen.size(), [=](std::int32_t t) { return t >= triangle_count; }))
    throw std::invalid_argument("seen: triangles must be below " + std::to_string(triangle_count));
  if (coordinates.shape(0) != points.shape(0) || end < 0 || end > triangle_count)
    throw std::invalid_argument("coordinates and end: must be those of the points and triangles");
  if (texels.shape(0) != texels.shape(1) || texels.shape(0) < 2 || count < 1 ||
      texels.shape(2) < static_cast<std::size_t>(3 * count))
    throw std::invalid_argument("texels: must be of shape (size, size, channels), channels at least 3 count");
  const raster::Textures textures{
      {texels.data(), texels.size()}, static_cast<int>(texels.shape(0)), static_cast<int>(texels.shape(2)), count};
  raster::Albedo result;
  {
    nb::gil_scoped_release release;
    result = raster::albedo({seen.data(), seen.size()}, rows_of<raster::Projected>(points),
                            rows_of<raster::Triangle>(triangles), rows_of<raster::TextureCoordinate>(coordinates), end,
                            textures, part, grid);
  }
  return std::make_tuple(
      handed_over<float, nb::shape<-1, -1>>(std::move(result.coverage), {height, width}),
      handed_over<float, nb::shape<-1, -1, -1, 3>>(std::move(result.mean),
                                                   {height, width, static_cast<std::size_t>(count), 3}),
      handed_over<std::int32_t, nb::shape<-1>>(std::move(result.hits), {static_cast<std::size_t>(end)}));
}

}  // namespace

NB_MODULE(_raster, module) {
  module.attr("BUILD_HASH") = raster::build_hash;
  module.def("visible", &visible, "points"_a, "triangles"_a, "window"_a, "grid"_a,
             "Return the triangle seen at each sample, shape (grid height, grid width), -1 where there is none.\n\n"
             "Points (V, 3): column, row [px] and depth. The window: left, top, width, height [px].");
  module.def("albedo", &albedo, "seen"_a, "points"_a, "triangles"_a, "coordinates"_a, "end"_a, "texels"_a, "count"_a,
             "window"_a, "grid"_a,
             "Return coverage (h, w), mean linear albedo (h, w, count, 3), and samples by triangle (end,).");
  module.def("decoded", &raster::decoded, "srgb"_a, "Decode sRGB in [0, 1] to linear light, within 2.2e-5.");
}
