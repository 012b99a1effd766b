#include "samples.hpp"

#include <limits>

namespace raster {

Plane interpolate(const std::array<Plane, 3>& barycentric, double a, double b, double c) {
  const auto& [p, q, r] = barycentric;
  return {p.along * a + q.along * b + r.along * c, p.down * a + q.down * b + r.down * c,
          p.origin * a + q.origin * b + r.origin * c};
}

Samples::Samples(Window window, int grid)
    : grid_(grid), left_(window.left - 0.5), top_(window.top - 0.5), shift_(grid) {
  for (int cell = 0; cell < grid; ++cell) {
    shift_[cell] = ((5 * cell) % grid + 0.5) / grid;
  }
}

std::array<Plane, 3> Corners::barycentric() const {
  const double area = doubled_area();
  const double edge_on = std::numeric_limits<double>::quiet_NaN();
  const double scale = area == 0.0 ? edge_on : 1.0 / area;
  std::array<Plane, 3> planes;
  for (int k = 0; k < 3; ++k) {
    // The other two corners, in the order of the triangle.
    const int p = (k + 1) % 3;
    const int q = (k + 2) % 3;
    planes[k].along = (y[p] - y[q]) * scale;
    planes[k].down = (x[q] - x[p]) * scale;
    planes[k].origin = (x[p] * y[q] - x[q] * y[p]) * scale;
  }
  return planes;
}

Corners project(const Samples& samples, std::span<const Projected> vertices,
                const Triangle& triangle) {
  Corners corners;
  const std::array<std::int32_t, 3> indices = {triangle.a, triangle.b, triangle.c};
  for (int k = 0; k < 3; ++k) {
    const Projected& vertex = vertices[indices[k]];
    corners.x[k] = samples.x(vertex.u);
    corners.y[k] = samples.y(vertex.v);
    corners.nearness[k] = 1.0 / vertex.depth;
  }
  return corners;
}

}  // namespace raster
