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
using Values = Input<float, nb::shape<-1>>;
using Plane = Input<float, nb::shape<-1, -1>>;
using Colors = Input<float, nb::shape<-1, -1, -1>>;
using Floor = Input<float, nb::shape<-1, -1, 3>>;
using Pictures = nb::ndarray<std::uint8_t, nb::shape<-1, -1, -1, 3>, nb::device::cpu>;
using WindowTuple = std::tuple<int, int, int, int>;

// Hand a vector over to Python as an array.
template <class Scalar, class Shape>
nb::ndarray<nb::numpy, Scalar, Shape, nb::c_contig> to_array(
    std::vector<Scalar> values, std::initializer_list<std::size_t> shape) {
  auto heap = std::make_unique<std::vector<Scalar>>(std::move(values));
  Scalar* data = heap->data();
  nb::capsule owner(heap.release(),
                    [](void* p) noexcept { delete static_cast<std::vector<Scalar>*>(p); });
  return {data, shape, owner};
}

template <class Item, class Array>
std::span<const Item> rows_of(const Array& array) {
  return {reinterpret_cast<const Item*>(array.data()), array.shape(0)};
}

template <class Array>
auto span_of(const Array& array) {
  return std::span(array.data(), array.size());
}

// ---- Checks
// --------------------------------------------------------------------------------------

void require(bool is_true, const std::string& message) {
  if (!is_true) throw std::invalid_argument(message);
}

void check_triangles(const Triangles& triangles, std::size_t point_count) {
  const auto count = static_cast<std::int32_t>(point_count);
  const auto is_index = [=](std::int32_t index) { return index >= 0 && index < count; };
  const auto indices = span_of(triangles);
  require(std::all_of(indices.begin(), indices.end(), is_index),
          "triangles: indices must be from 0 to " + std::to_string(count - 1));
}

void check_points(const Points& points) {
  for (std::size_t i = 0; i < points.shape(0); ++i) {
    require(points(i, 2) > 0.0,
            "points: depth must be above 0, and is not at point " + std::to_string(i));
  }
}

void check_window(raster::Window window, int grid) {
  require(window.width >= 1 && window.height >= 1 && grid >= 1 && grid <= 64,
          "window and grid: sizes must be at least 1, and grid at most 64");
}

void check_seen(const Seen& seen, const raster::VisibleTriangles& visible,
                std::size_t triangle_count) {
  const auto height = static_cast<std::size_t>(visible.window.height);
  const auto width = static_cast<std::size_t>(visible.window.width);
  require(seen.shape(0) == height * visible.grid && seen.shape(1) == width * visible.grid,
          "seen: must have grid x grid samples a pixel of the window");
  const auto count = static_cast<std::int32_t>(triangle_count);
  const auto is_triangle = [=](std::int32_t number) { return number < count; };
  require(std::all_of(visible.numbers.begin(), visible.numbers.end(), is_triangle),
          "seen: triangles must be below " + std::to_string(count));
}

void check_texels(const Texels& texels, int count) {
  require(texels.shape(0) == texels.shape(1) && texels.shape(0) >= 2 && count >= 1 &&
              texels.shape(2) >= static_cast<std::size_t>(3 * count),
          "texels: must be of shape (size, size, channels), channels at least 3 count");
}

void check_radii(const Plane& radii, const Colors& values) {
  const auto all = span_of(radii);
  const bool is_positive = std::all_of(all.begin(), all.end(), [](float r) { return r >= 0.0f; });
  require(radii.shape(0) == values.shape(0) && radii.shape(1) == values.shape(1) && is_positive,
          "down and across: radii must be at least 0, and one for each pixel");
}

raster::Window as_window(const WindowTuple& window) {
  const auto [left, top, width, height] = window;
  return {left, top, width, height};
}

raster::Mesh as_mesh(const Points& points, const Triangles& triangles) {
  check_points(points);
  check_triangles(triangles, points.shape(0));
  return {rows_of<raster::Projected>(points), rows_of<raster::Triangle>(triangles)};
}

raster::Part as_part(const Colors& albedo, const WindowTuple& tuple, std::size_t colors) {
  const raster::Window window = as_window(tuple);
  require(window.width >= 0 && window.height >= 0 &&
              albedo.shape(0) == static_cast<std::size_t>(window.height) &&
              albedo.shape(1) == static_cast<std::size_t>(window.width) &&
              albedo.shape(2) == colors,
          "albedo: must be of the shape of its window, and of three colours a picture");
  return {window, span_of(albedo)};
}

// ---- Functions
// -----------------------------------------------------------------------------------

auto visible(const Points& points, const Triangles& triangles, const WindowTuple& tuple, int grid) {
  const raster::Window window = as_window(tuple);
  check_window(window, grid);
  const raster::Mesh mesh = as_mesh(points, triangles);
  std::vector<std::int32_t> seen;
  {
    nb::gil_scoped_release release;
    seen = raster::visible(mesh, window, grid);
  }
  const auto height = static_cast<std::size_t>(window.height * grid);
  const auto width = static_cast<std::size_t>(window.width * grid);
  return to_array<std::int32_t, nb::shape<-1, -1>>(std::move(seen), {height, width});
}

auto albedo(const Seen& seen, const Points& points, const Triangles& triangles,
            const Coordinates& coordinates, int end, const Texels& texels, int count,
            const WindowTuple& tuple, int grid) {
  const raster::Window window = as_window(tuple);
  check_window(window, grid);
  const raster::Mesh mesh = as_mesh(points, triangles);
  const raster::VisibleTriangles visible{span_of(seen), window, grid};
  check_seen(seen, visible, triangles.shape(0));
  const bool is_end = end >= 0 && static_cast<std::size_t>(end) <= triangles.shape(0);
  require(coordinates.shape(0) == points.shape(0) && is_end,
          "coordinates and end: must be those of the points and triangles");
  check_texels(texels, count);
  const raster::Textures textures{.texels = span_of(texels),
                                  .size = static_cast<int>(texels.shape(0)),
                                  .channels = static_cast<int>(texels.shape(2)),
                                  .count = count};
  raster::Albedo result;
  {
    nb::gil_scoped_release release;
    const auto uv = rows_of<raster::TextureCoordinate>(coordinates);
    result = raster::albedo(visible, mesh, uv, end, textures);
  }
  const auto height = static_cast<std::size_t>(window.height);
  const auto width = static_cast<std::size_t>(window.width);
  const auto pictures = static_cast<std::size_t>(count);
  const auto triangle_count = static_cast<std::size_t>(end);
  return std::make_tuple(
      to_array<float, nb::shape<-1, -1>>(std::move(result.coverage), {height, width}),
      to_array<float, nb::shape<-1, -1, -1, 3>>(std::move(result.mean),
                                                {height, width, pictures, 3}),
      to_array<std::int32_t, nb::shape<-1>>(std::move(result.hits), {triangle_count}),
      to_array<float, nb::shape<-1, 3>>(std::move(result.overall), {pictures, 3}), result.area);
}

void compose(const Halves& shading, std::tuple<float, float, float> albedos, const Values& overall,
             const Plane& coverage, const Colors& mean, const WindowTuple& window,
             const Colors& reflected, const WindowTuple& reflected_window, const Floor& floor,
             Pictures pictures) {
  const std::size_t height = pictures.shape(1);
  const std::size_t width = pictures.shape(2);
  const std::size_t colors = overall.size();
  // Pixels of the light across one of a picture.
  const std::size_t fine = height > 0 ? shading.shape(0) / height : 0;
  require(colors == 3 * pictures.shape(0) && shading.shape(0) == fine * height &&
              shading.shape(1) == fine * width && floor.shape(0) == height &&
              floor.shape(1) == width,
          "shading, overall, floor and pictures: must be of one size, or a multiple of it, and "
          "colours");
  require(pictures.stride(3) == 1 && pictures.stride(2) == 3 &&
              pictures.stride(1) == static_cast<std::int64_t>(3 * width),
          "pictures: each must be contiguous");
  const raster::Layers layers{.overall = span_of(overall),
                              .cloth = as_part(mean, window, colors),
                              .coverage = span_of(coverage),
                              .reflected = as_part(reflected, reflected_window, colors),
                              .floor = span_of(floor)};
  require(coverage.shape(0) == mean.shape(0) && coverage.shape(1) == mean.shape(1),
          "coverage: must be of the shape of its window");
  const auto [camera, bright, dark] = albedos;
  const raster::Shading light{.light = span_of(shading),
                              .width = static_cast<int>(width),
                              .height = static_cast<int>(height),
                              .fine = static_cast<int>(fine),
                              .camera = camera,
                              .bright = bright,
                              .dark = dark};
  nb::gil_scoped_release release;
  raster::compose(light, layers, {pictures.data(), static_cast<std::size_t>(pictures.stride(0))});
}

auto blurred(const Colors& values, const Plane& down, const Plane& across) {
  check_radii(down, values);
  check_radii(across, values);
  const raster::Image image{.values = span_of(values),
                            .width = static_cast<int>(values.shape(1)),
                            .height = static_cast<int>(values.shape(0)),
                            .count = static_cast<int>(values.shape(2))};
  std::vector<float> result;
  {
    nb::gil_scoped_release release;
    result = raster::blurred(image, span_of(down), span_of(across));
  }
  return to_array<float, nb::shape<-1, -1, -1>>(
      std::move(result), {values.shape(0), values.shape(1), values.shape(2)});
}

auto normals(const Points& points, const Triangles& triangles) {
  check_triangles(triangles, points.shape(0));
  return to_array<double, nb::shape<-1, 3>>(
      raster::normals(span_of(points), rows_of<raster::Triangle>(triangles)), {points.shape(0), 3});
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
