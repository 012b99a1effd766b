#include "raster.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

namespace raster {

namespace {

// f(x, y) = along x + down y + at, in the image.
struct Plane {
  double along, down, at;

  double operator()(double x, double y) const { return along * x + down * y + at; }
};

Plane sum(const std::array<Plane, 3>& planes, double a, double b, double c) {
  return {planes[0].along * a + planes[1].along * b + planes[2].along * c,
          planes[0].down * a + planes[1].down * b + planes[2].down * c,
          planes[0].at * a + planes[1].at * b + planes[2].at * c};
}

// Where the samples are, in units of a cell from the window's upper left corner.
class Samples {
 public:
  Samples(Window window, int grid)
      : grid_(grid), left_(window.left - 0.5), top_(window.top - 0.5), shift_(grid) {
    for (int cell = 0; cell < grid; ++cell) shift_[cell] = ((5 * cell) % grid + 0.5) / grid;
  }

  double x(double u) const { return (u - left_) * grid_; }
  double y(double v) const { return (v - top_) * grid_; }
  double shift(int cell) const { return shift_[cell % grid_]; }

 private:
  int grid_;
  double left_, top_;
  std::vector<double> shift_;
};

// The barycentric coordinates of a triangle in the image, each 1 at its own corner. Those of a
// triangle that is seen edge-on are NaN, and no sample is in it.
std::array<Plane, 3> barycentric(const std::array<double, 3>& x, const std::array<double, 3>& y) {
  const double area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]);
  const double scale = area == 0.0 ? std::numeric_limits<double>::quiet_NaN() : 1.0 / area;
  std::array<Plane, 3> planes;
  for (int k = 0; k < 3; ++k) {
    const int p = (k + 1) % 3, q = (k + 2) % 3;
    planes[k] = {(y[p] - y[q]) * scale, (x[q] - x[p]) * scale, (x[p] * y[q] - x[q] * y[p]) * scale};
  }
  return planes;
}

struct Corners {
  std::array<double, 3> x, y, nearness;
};

Corners corners(const Samples& samples, std::span<const Projected> vertices,
                const Triangle& triangle) {
  Corners found;
  const std::array<std::int32_t, 3> index = {triangle.a, triangle.b, triangle.c};
  for (int k = 0; k < 3; ++k) {
    const Projected& vertex = vertices[index[k]];
    found.x[k] = samples.x(vertex.u);
    found.y[k] = samples.y(vertex.v);
    found.nearness[k] = 1.0 / vertex.depth;
  }
  return found;
}

// Cells whose samples may be between low and high, of `count`.
std::pair<int, int> cells(double low, double high, int count) {
  if (!(high >= 0.0 && low < count)) return {0, 0};
  return {static_cast<int>(std::max(low, 0.0)), static_cast<int>(std::min(high, count - 1.0)) + 1};
}

// As many floats as the widest register holds.
constexpr int wide = 16;

// A plane about the first cell of a triangle, where single precision is fine enough.
struct LocalPlane {
  float along, down, at;
};

LocalPlane local(const Plane& plane, int left, int top) {
  return {static_cast<float>(plane.along), static_cast<float>(plane.down),
          static_cast<float>(plane(left, top))};
}

// Samples so far: `stride` is the width and some unused cells, so that whole registers can be
// written.
struct Buffer {
  std::vector<float> nearest;  // 1 / depth
  std::vector<std::int32_t> seen;
  std::vector<float> column_shift, row_shift;
  std::size_t stride;
};

// Draw one triangle on the cells of `rows` rows and `columns` columns from (left, top) on. What is
// not in the triangle fails its three tests, so that it does no harm to draw some cells more than
// asked for.
RASTER_KERNEL void draw(const LocalPlane& a, const LocalPlane& b, const LocalPlane& c,
                        const LocalPlane& near, std::int32_t number, int left, int top, int columns,
                        int rows, Buffer& buffer) {
  for (int first = 0; first < columns; first += wide) {
    const float* const shift = buffer.column_shift.data() + left + first;
    float a_here[wide], b_here[wide], c_here[wide], near_here[wide];
    for (int k = 0; k < wide; ++k) {
      const float across = static_cast<float>(first + k);
      a_here[k] = a.along * across + a.down * shift[k];
      b_here[k] = b.along * across + b.down * shift[k];
      c_here[k] = c.along * across + c.down * shift[k];
      near_here[k] = near.along * across + near.down * shift[k];
    }
    for (int row = 0; row < rows; ++row) {
      const float x = buffer.row_shift[top + row], y = static_cast<float>(row);
      const float a_row = a.along * x + a.down * y + a.at, b_row = b.along * x + b.down * y + b.at;
      const float c_row = c.along * x + c.down * y + c.at,
                  near_row = near.along * x + near.down * y + near.at;
      const std::size_t at = (top + row) * buffer.stride + left + first;
      float* const __restrict nearest = buffer.nearest.data() + at;
      std::int32_t* const __restrict seen = buffer.seen.data() + at;
      for (int k = 0; k < wide; ++k) {
        const float depth = near_here[k] + near_row;
        const bool hit = (a_here[k] + a_row >= 0.0f) & (b_here[k] + b_row >= 0.0f) &
                         (c_here[k] + c_row >= 0.0f) & (depth > nearest[k]);
        nearest[k] = hit ? depth : nearest[k];
        seen[k] = hit ? number : seen[k];
      }
    }
  }
}

}  // namespace

std::vector<std::int32_t> visible(std::span<const Projected> vertices,
                                  std::span<const Triangle> triangles, Window window, int grid) {
  const int columns = window.width * grid, rows = window.height * grid;
  const Samples samples(window, grid);
  const std::size_t stride = columns + wide, size = stride * rows;
  Buffer buffer{std::vector<float>(size, 0.0f), std::vector<std::int32_t>(size, -1),
                std::vector<float>(stride), std::vector<float>(rows), stride};
  for (std::size_t i = 0; i < stride; ++i)
    buffer.column_shift[i] = static_cast<float>(samples.shift(i));
  for (int j = 0; j < rows; ++j) buffer.row_shift[j] = static_cast<float>(samples.shift(j));
  for (std::size_t number = 0; number < triangles.size(); ++number) {
    const auto [x, y, nearness] = corners(samples, vertices, triangles[number]);
    const auto [left, right] = cells(std::ranges::min(x), std::ranges::max(x), columns);
    const auto [top, bottom] = cells(std::ranges::min(y), std::ranges::max(y), rows);
    if (left == right || top == bottom) continue;
    const auto inside = barycentric(x, y);
    const Plane near = sum(inside, nearness[0], nearness[1], nearness[2]);
    draw(local(inside[0], left, top), local(inside[1], left, top), local(inside[2], left, top),
         local(near, left, top), static_cast<std::int32_t>(number), left, top, right - left,
         bottom - top, buffer);
  }
  std::vector<std::int32_t> seen(static_cast<std::size_t>(columns) * rows);
  for (int j = 0; j < rows; ++j)
    std::copy_n(buffer.seen.begin() + j * stride, columns, seen.begin() + j * std::size_t(columns));
  return seen;
}

namespace {

constexpr int lanes = 8;  // channels that are looked up together

// sRGB to linear light, above the linear toe a polynomial.
#define RASTER_DECODED(c)                 \
  ((c) <= 0.04045f                        \
       ? (c) * (1.0f / 12.92f)            \
       : 0.00101080102f +                 \
             (c) * (0.0301503654f +       \
                    (c) * (0.538876185f + \
                           (c) * (0.611357191f + (c) * (-0.241147234f + (c) * 0.0597738063f)))))

// One place on the textures: its texel, of least row and column, and how far it is to the next
// ones.
struct Place {
  std::uint32_t texel;
  float along, down;
};

Place place(const Textures& textures, double u, double v) {
  const int size = textures.size;
  const double x = std::min(std::max(u * size - 0.5, 0.0), size - 1.0);
  const double y = std::min(std::max(v * size - 0.5, 0.0), size - 1.0);
  const int i = std::min(static_cast<int>(x), size - 2),
            j = std::min(static_cast<int>(y), size - 2);
  return {static_cast<std::uint32_t>(j) * size + i, static_cast<float>(x - i),
          static_cast<float>(y - j)};
}

// Write to `sums` the sum of the textures over places, decoded.
RASTER_KERNEL void sum_lookups(const Textures& textures, const Place* places, int count,
                               float* __restrict sums) {
  const int channels = textures.channels;
  const std::size_t right = channels, below = static_cast<std::size_t>(textures.size) * channels;
  std::fill_n(sums, channels, 0.0f);
  for (int p = 0; p < count; ++p) {
    const float along = places[p].along, down = places[p].down;
    const float* const __restrict texel = textures.texels.data() + places[p].texel * right;
    for (int first = 0; first < channels; first += lanes) {
      const float* const __restrict at = texel + first;
      float* const __restrict sum = sums + first;
      for (int k = 0; k < lanes; ++k) {
        const float t00 = at[k], t10 = at[k + right], t01 = at[k + below],
                    t11 = at[k + below + right];
        const float lower = t00 + along * (t10 - t00), upper = t01 + along * (t11 - t01);
        const float color = lower + down * (upper - lower);
        sum[k] += RASTER_DECODED(color);
      }
    }
  }
}

}  // namespace

float decoded(float srgb) { return RASTER_DECODED(srgb); }

Albedo albedo(std::span<const std::int32_t> seen, std::span<const Projected> vertices,
              std::span<const Triangle> triangles, std::span<const TextureCoordinate> coordinates,
              std::int32_t end, const Textures& textures, Window window, int grid) {
  const Samples samples(window, grid);
  const int columns = window.width * grid, colors = 3 * textures.count;
  const std::size_t pixels = static_cast<std::size_t>(window.width) * window.height;
  Albedo result{std::vector<float>(pixels), std::vector<float>(pixels * colors),
                std::vector<std::int32_t>(end), std::vector<float>(colors), 0.0};
  std::vector<double> weighted(colors, 0.0);
  double weight = 0.0;
  // Texture coordinates over depth, and 1 / depth, are linear in the image.
  struct Lookup {
    Plane u, v, near;
  };
  std::vector<Lookup> lookups(end);
  for (std::int32_t number = 0; number < end; ++number) {
    const Triangle& triangle = triangles[number];
    const auto [x, y, q] = corners(samples, vertices, triangle);
    const auto inside = barycentric(x, y);
    result.area += 0.5 * std::abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])) /
                   (grid * grid);
    const TextureCoordinate &a = coordinates[triangle.a], &b = coordinates[triangle.b],
                            &c = coordinates[triangle.c];
    lookups[number] = {sum(inside, a.u * q[0], b.u * q[1], c.u * q[2]),
                       sum(inside, a.v * q[0], b.v * q[1], c.v * q[2]),
                       sum(inside, q[0], q[1], q[2])};
  }
  std::vector<float> sums(textures.channels);
  std::vector<Place> places(static_cast<std::size_t>(grid) * grid);
  for (int row = 0; row < window.height; ++row) {
    for (int column = 0; column < window.width; ++column) {
      int count = 0, covered = 0;
      for (int j = row * grid; j < (row + 1) * grid; ++j) {
        for (int i = column * grid; i < (column + 1) * grid; ++i) {
          const std::int32_t number = seen[static_cast<std::size_t>(j) * columns + i];
          if (number < 0 || number >= end) continue;
          ++result.hits[number];
          ++covered;
          if (count > 0 && (i + j) % 2 != 0) continue;
          const Lookup& lookup = lookups[number];
          const double x = i + samples.shift(j), y = j + samples.shift(i),
                       depth = 1.0 / lookup.near(x, y);
          places[count++] = place(textures, lookup.u(x, y) * depth, lookup.v(x, y) * depth);
        }
      }
      if (count == 0) continue;
      sum_lookups(textures, places.data(), count, sums.data());
      const std::size_t pixel = static_cast<std::size_t>(row) * window.width + column;
      result.coverage[pixel] = static_cast<float>(covered) / static_cast<float>(grid * grid);
      weight += covered;
      for (int color = 0; color < colors; ++color) {
        const float mean = sums[color] / count;
        result.mean[pixel * colors + color] = mean;
        weighted[color] += covered * static_cast<double>(mean);
      }
    }
  }
  if (weight > 0.0)
    for (int color = 0; color < colors; ++color)
      result.overall[color] = static_cast<float>(weighted[color] / weight);
  return result;
}

}  // namespace raster
