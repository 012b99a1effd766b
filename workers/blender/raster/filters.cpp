#include <algorithm>
#include <array>
#include <cmath>

#include "raster.hpp"

namespace raster {

namespace {

// A line of a table that lies between two of its own: (1 - share) table[low] + share table[low +
// 1].
struct Between {
  std::size_t low;
  double share;
};

Between between(double position, int count) {
  const double inside = std::min(std::max(position, 0.0), static_cast<double>(count));
  const int low = std::min(static_cast<int>(inside), count - 1);
  return {static_cast<std::size_t>(low), inside - low};
}

// Add `sign` times the table, taken between its lines and columns, to `sums`.
RASTER_KERNEL void add_corner(const double* __restrict table, std::size_t row_step, int count,
                              Between row, Between column, double sign, double* __restrict sums) {
  const double* const __restrict above = table + row.low * row_step + column.low * count;
  const double* const __restrict below = above + row_step;
  const double d = sign * row.share;
  const double c = column.share;
  const double w00 = (sign - d) * (1.0 - c);
  const double w01 = (sign - d) * c;
  const double w10 = d * (1.0 - c);
  const double w11 = d * c;
  for (int k = 0; k < count; ++k) {
    sums[k] += w00 * above[k] + w01 * above[k + count] + w10 * below[k] + w11 * below[k + count];
  }
}

// Sums of an image over rectangles from its corner on, with a row and a column of zeros before
// [Crow 1984].
class SummedAreaTable {
 public:
  SummedAreaTable(int width, int height, int count)
      : width_(width),
        height_(height),
        count_(count),
        row_step_(static_cast<std::size_t>(width + 1) * count),
        table_(row_step_ * (height + 1), 0.0),
        sums_(count) {}

  void fill(std::span<const float> values) {
    for (int row = 0; row < height_; ++row) {
      std::fill(sums_.begin(), sums_.end(), 0.0);
      const float* value = values.data() + static_cast<std::size_t>(row) * width_ * count_;
      const double* above = table_.data() + row * row_step_ + count_;
      double* here = table_.data() + (row + 1) * row_step_ + count_;
      for (int column = 0; column < width_; ++column) {
        for (int k = 0; k < count_; ++k) {
          sums_[k] += value[k];
          here[k] = above[k] + sums_[k];
        }
        value += count_;
        above += count_;
        here += count_;
      }
    }
  }

  // Return the sums over a box about the pixel in a row and a column, of half its sides.
  std::span<const double> sum(int row, int column, double half_down, double half_across) {
    const Between top = between(row + 0.5 - half_down, height_);
    const Between bottom = between(row + 0.5 + half_down, height_);
    const Between left = between(column + 0.5 - half_across, width_);
    const Between right = between(column + 0.5 + half_across, width_);
    std::fill(sums_.begin(), sums_.end(), 0.0);
    add(bottom, right, 1.0);
    add(top, right, -1.0);
    add(bottom, left, -1.0);
    add(top, left, 1.0);
    return sums_;
  }

 private:
  void add(Between row, Between column, double sign) {
    add_corner(table_.data(), row_step_, count_, row, column, sign, sums_.data());
  }

  int width_;
  int height_;
  int count_;
  std::size_t row_step_;
  std::vector<double> table_;
  std::vector<double> sums_;
};

using Vector = std::array<double, 3>;

Vector difference(const double* a, const double* b) {
  return {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
}

Vector cross(const Vector& p, const Vector& q) {
  return {p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]};
}

}  // namespace

std::vector<float> blurred(const Image& image, std::span<const float> down,
                           std::span<const float> across) {
  SummedAreaTable table(image.width, image.height, image.count);
  std::vector<float> result(image.values.begin(), image.values.end());
  // The mean over a box twice is the mean over a tent, which has no edges.
  for (int pass = 0; pass < 2; ++pass) {
    table.fill(result);
    for (int row = 0; row < image.height; ++row) {
      for (int column = 0; column < image.width; ++column) {
        const std::size_t pixel = static_cast<std::size_t>(row) * image.width + column;
        const double half_down = std::sqrt(0.25 + down[pixel] * down[pixel]);
        const double half_across = std::sqrt(0.25 + across[pixel] * across[pixel]);
        const std::span<const double> sums = table.sum(row, column, half_down, half_across);
        const double area = 4.0 * half_down * half_across;
        for (int k = 0; k < image.count; ++k) {
          result[pixel * image.count + k] = static_cast<float>(sums[k] / area);
        }
      }
    }
  }
  return result;
}

std::vector<double> normals(std::span<const double> points, std::span<const Triangle> triangles) {
  std::vector<double> sums(points.size(), 0.0);
  for (const Triangle& triangle : triangles) {
    const double* const a = points.data() + 3 * triangle.a;
    const double* const b = points.data() + 3 * triangle.b;
    const double* const c = points.data() + 3 * triangle.c;
    // The cross product of two edges is as long as twice the area.
    const Vector normal = cross(difference(b, a), difference(c, a));
    for (const std::int32_t vertex : {triangle.a, triangle.b, triangle.c}) {
      for (int k = 0; k < 3; ++k) {
        sums[3 * vertex + k] += normal[k];
      }
    }
  }
  for (std::size_t n = 0; n < sums.size(); n += 3) {
    double* const normal = sums.data() + n;
    const double length =
        std::sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
    // A vertex of no triangle, or of triangles without area, has no normal.
    if (length == 0.0) continue;
    for (int k = 0; k < 3; ++k) {
      normal[k] /= length;
    }
  }
  return sums;
}

}  // namespace raster
