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
using Halves = Input<std::uint16_t, nb::shape<-1, -1, 3>>;
using Plane = Input<float, nb::shape<-1, -1>>;
using Colors = Input<float, nb::shape<-1, -1, -1>>;
using Doubles = Input<double, nb::shape<-1, -1>>;
using Pictures = nb::ndarray<std::uint8_t, nb::shape<-1, -1, -1, 3>, nb::device::cpu>;
using WindowTuple = std::tuple<int, int, int, int>;

template <class Scalar, class Shape>
nb::ndarray<nb::numpy, Scalar, Shape, nb::c_contig> handed_over(
    std::vector<Scalar> values, std::initializer_list<std::size_t> shape) {
  auto held = std::make_unique<std::vector<Scalar>>(std::move(values));
  Scalar* data = held->data();
  nb::capsule owner(held.release(),
                    [](void* p) noexcept { delete static_cast<std::vector<Scalar>*>(p); });
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
      throw std::invalid_argument("points: depth must be above 0, and is not at point " +
                                  std::to_string(i));
  }
  const auto count = static_cast<std::int32_t>(points.shape(0));
  const std::int32_t* indices = triangles.data();
  if (std::any_of(indices, indices + triangles.size(),
                  [=](std::int32_t v) { return v < 0 || v >= count; }))
    throw std::invalid_argument("triangles: indices must be from 0 to " +
                                std::to_string(count - 1));
}

raster::Window as_window(const WindowTuple& window) {
  const auto [left, top, width, height] = window;
  return {left, top, width, height};
}

auto visible(const Points& points, const Triangles& triangles, const WindowTuple& window,
             int grid) {
  check(points, triangles, window, grid);
  const raster::Window part = as_window(window);
  std::vector<std::int32_t> seen;
  {
    nb::gil_scoped_release release;
    seen = raster::visible(rows_of<raster::Projected>(points), rows_of<raster::Triangle>(triangles),
                           part, grid);
  }
  const auto height = static_cast<std::size_t>(part.height * grid),
             width = static_cast<std::size_t>(part.width * grid);
  return handed_over<std::int32_t, nb::shape<-1, -1>>(std::move(seen), {height, width});
}

auto albedo(const Seen& seen, const Points& points, const Triangles& triangles,
            const Coordinates& coordinates, int end, const Texels& texels, int count,
            const WindowTuple& window, int grid) {
  check(points, triangles, window, grid);
  const raster::Window part = as_window(window);
  const auto height = static_cast<std::size_t>(part.height),
             width = static_cast<std::size_t>(part.width);
  if (seen.shape(0) != height * grid || seen.shape(1) != width * grid)
    throw std::invalid_argument("seen: must have grid x grid samples a pixel of the window");
  const auto triangle_count = static_cast<std::int32_t>(triangles.shape(0));
  if (std::any_of(seen.data(), seen.data() + seen.size(),
                  [=](std::int32_t t) { return t >= triangle_count; }))
    throw std::invalid_argument("seen: triangles must be below " + std::to_string(triangle_count));
  if (coordinates.shape(0) != points.shape(0) || end < 0 || end > triangle_count)
    throw std::invalid_argument("coordinates and end: must be those of the points and triangles");
  if (texels.shape(0) != texels.shape(1) || texels.shape(0) < 2 || count < 1 ||
      texels.shape(2) < static_cast<std::size_t>(3 * count))
    throw std::invalid_argument(
        "texels: must be of shape (size, size, channels), channels at least 3 count");
  const raster::Textures textures{{texels.data(), texels.size()},
                                  static_cast<int>(texels.shape(0)),
                                  static_cast<int>(texels.shape(2)),
                                  count};
  raster::Albedo result;
  {
    nb::gil_scoped_release release;
    result =
        raster::albedo({seen.data(), seen.size()}, rows_of<raster::Projected>(points),
                       rows_of<raster::Triangle>(triangles),
                       rows_of<raster::TextureCoordinate>(coordinates), end, textures, part, grid);
  }
  return std::make_tuple(
      handed_over<float, nb::shape<-1, -1>>(std::move(result.coverage), {height, width}),
      handed_over<float, nb::shape<-1, -1, -1, 3>>(
          std::move(result.mean), {height, width, static_cast<std::size_t>(count), 3}),
      handed_over<std::int32_t, nb::shape<-1>>(std::move(result.hits),
                                               {static_cast<std::size_t>(end)}),
      handed_over<float, nb::shape<-1, 3>>(std::move(result.overall),
                                           {static_cast<std::size_t>(count), 3}),
      result.area);
}

raster::Part part(const Colors& albedo, const WindowTuple& window, std::size_t colors) {
  const raster::Window place = as_window(window);
  if (place.width < 0 || place.height < 0 ||
      albedo.shape(0) != static_cast<std::size_t>(place.height) ||
      albedo.shape(1) != static_cast<std::size_t>(place.width) || albedo.shape(2) != colors)
    throw std::invalid_argument(
        "albedo: must be of the shape of its window, and of three colours a picture");
  return {place, {albedo.data(), albedo.size()}};
}

void compose(const Halves& shading, std::tuple<float, float, float> albedos,
             const Input<float, nb::shape<-1>>& overall, const Plane& coverage, const Colors& mean,
             const WindowTuple& window, const Colors& reflected,
             const WindowTuple& reflected_window, const Input<float, nb::shape<-1, -1, 3>>& floor,
             Pictures pictures) {
  const std::size_t height = pictures.shape(1), width = pictures.shape(2), colors = overall.size();
  const std::size_t fine = height > 0 ? shading.shape(0) / height : 0;
  if (colors != 3 * pictures.shape(0) || shading.shape(0) != fine * height ||
      shading.shape(1) != fine * width || floor.shape(0) != height || floor.shape(1) != width)
    throw std::invalid_argument(
        "shading, overall, floor and pictures: must be of one size, or a multiple of it, and "
        "colours");
  if (pictures.stride(3) != 1 || pictures.stride(2) != 3 ||
      pictures.stride(1) != static_cast<std::int64_t>(3 * width))
    throw std::invalid_argument("pictures: each must be contiguous");
  const raster::Part cloth = part(mean, window, colors),
                     mirrored = part(reflected, reflected_window, colors);
  if (coverage.shape(0) != mean.shape(0) || coverage.shape(1) != mean.shape(1))
    throw std::invalid_argument("coverage: must be of the shape of its window");
  const raster::Shading light{{shading.data(), shading.size()},
                              static_cast<int>(width),
                              static_cast<int>(height),
                              static_cast<int>(fine),
                              std::get<0>(albedos),
                              std::get<1>(albedos),
                              std::get<2>(albedos)};
  nb::gil_scoped_release release;
  raster::compose(light, {overall.data(), overall.size()}, cloth,
                  {coverage.data(), coverage.size()}, mirrored, {floor.data(), floor.size()},
                  pictures.data(), static_cast<std::size_t>(pictures.stride(0)));
}

auto blurred(const Colors& values, const Plane& down, const Plane& across) {
  const std::size_t height = values.shape(0), width = values.shape(1), count = values.shape(2);
  for (const Plane* radius : {&down, &across})
    if (radius->shape(0) != height || radius->shape(1) != width ||
        std::any_of(radius->data(), radius->data() + radius->size(),
                    [](float r) { return !(r >= 0.0f); }))
      throw std::invalid_argument(
          "down and across: radii must be at least 0, and one for each pixel");
  std::vector<float> result;
  {
    nb::gil_scoped_release release;
    result = raster::blurred({values.data(), values.size()}, {down.data(), down.size()},
                             {across.data(), across.size()}, static_cast<int>(width),
                             static_cast<int>(height), static_cast<int>(count));
  }
  return handed_over<float, nb::shape<-1, -1, -1>>(std::move(result), {height, width, count});
}

auto normals(const Points& points, const Triangles& triangles) {
  const auto count = static_cast<std::int32_t>(points.shape(0));
  const std::int32_t* indices = triangles.data();
  if (std::any_of(indices, indices + triangles.size(),
                  [=](std::int32_t v) { return v < 0 || v >= count; }))
    throw std::invalid_argument("triangles: indices must be from 0 to " +
                                std::to_string(count - 1));
  return handed_over<double, nb::shape<-1, 3>>(
      raster::normals({points.data(), points.size()}, rows_of<raster::Triangle>(triangles)),
      {points.shape(0), 3});
}

}  // namespace

NB_MODULE(_raster, module) {
  module.attr("BUILD_HASH") = raster::build_hash;
  module.attr("TOLERANCE") = raster::tolerance;
  module.def(
      "visible", &visible, "points"_a, "triangles"_a, "window"_a, "grid"_a,
      "Return the triangle seen at each sample, shape (grid height, grid width), -1 if there is "
      "none.\n\n"
      "Points (V, 3): column, row [px] and depth. The window: left, top, width, height [px].");
  module.def("albedo", &albedo, "seen"_a, "points"_a, "triangles"_a, "coordinates"_a, "end"_a,
             "texels"_a, "count"_a, "window"_a, "grid"_a,
             "Return coverage (h, w), mean linear albedo (h, w, count, 3), samples by triangle "
             "(end,), the mean of all\n"
             "(count, 3), and the area of the triangles, each seen alone [px].");
  module.def("compose", &compose, "shading"_a, "albedos"_a, "overall"_a, "coverage"_a, "mean"_a,
             "window"_a, "reflected"_a, "reflected_window"_a, "floor"_a, "pictures"_a,
             "Write pictures (count, h, w, 3) of a shading (n h, n w, 3), half floats given as "
             "uint16; coverage and mean\n"
             "are in its pixels, too.");
  module.def("blurred", &blurred, "values"_a, "down"_a, "across"_a,
             "Return values (h, w, k), blurred about each pixel by radii of its own (h, w) [px].");
  module.def("normals", &normals, "points"_a, "triangles"_a,
             "Return the unit normals of vertices (V, 3).");
  module.def("decoded", &raster::decoded, "srgb"_a,
             "Decode sRGB in [0, 1] to linear light, within 2.2e-5.");
}
