// Triangles in the image, and the places of its samples: what visibility and albedo share.
#pragma once

#include <array>
#include <vector>

#include "raster.hpp"

namespace raster {

// f(x, y) = along x + down y + origin, in the image.
struct Plane {
  double along;
  double down;
  double origin;

  double operator()(double x, double y) const { return along * x + down * y + origin; }
};

// The linear function that has the values a, b and c at the corners of a triangle, from the
// barycentric coordinates of the triangle.
Plane interpolate(const std::array<Plane, 3>& barycentric, double a, double b, double c);

// The places of the samples, in units of a cell from the window's upper left corner.
class Samples {
 public:
  Samples(Window window, int grid);

  double x(double u) const { return (u - left_) * grid_; }
  double y(double v) const { return (v - top_) * grid_; }

  // The place of a sample inside its cell.
  double shift(int cell) const { return shift_[cell % grid_]; }

 private:
  int grid_;
  double left_;
  double top_;
  std::vector<double> shift_;
};

// The corners of a triangle in units of a cell, and 1 / depth there.
struct Corners {
  std::array<double, 3> x;
  std::array<double, 3> y;
  std::array<double, 3> nearness;

  // Twice the area of the triangle, negative if it is seen from behind.
  double doubled_area() const {
    return (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
  }

  // The barycentric coordinates, each 1 at its own corner. They are NaN for a triangle that is seen
  // edge-on, so that no sample is in it.
  std::array<Plane, 3> barycentric() const;
};

Corners project(const Samples& samples, std::span<const Projected> vertices,
                const Triangle& triangle);

}  // namespace raster
