#include "raster.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

// Wider vectors where the processor has them. Nothing is contracted or reordered, so both versions give the same bits.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define RASTER_KERNEL __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define RASTER_KERNEL
#endif

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
  Samples(Window window, int grid) : grid_(grid), left_(window.left - 0.5), top_(window.top - 0.5), shift_(grid) {
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

// The barycentric coordinates of a triangle in the image, each 1 at its own corner. Those of a triangle that is seen
// edge-on are NaN, and no sample is in it.
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

Corners corners(const Samples& samples, std::span<const Projected> vertices, const Triangle& triangle) {
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

}  // namespace

std::vector<std::int32_t> visible(std::span<const Projected> vertices, std::span<const Triangle> triangles,
                                  Window window, int grid) {
  const int columns = window.width * grid, rows = window.height * grid;
  const Samples samples(window, grid);
  std::vector<std::int32_t> seen(static_cast<std::size_t>(columns) * rows, -1);
  std::vector<float> nearest(seen.size(), 0.0f);  // 1 / depth
  std::vector<double> column_shift(columns), row_shift(rows);
  for (int i = 0; i < columns; ++i) column_shift[i] = samples.shift(i);
  for (int j = 0; j < rows; ++j) row_shift[j] = samples.shift(j);
  for (std::size_t number = 0; number < triangles.size(); ++number) {
    const auto [x, y, nearness] = corners(samples, vertices, triangles[number]);
    const auto [left, right] = cells(std::ranges::min(x), std::ranges::max(x), columns);
    const auto [top, bottom] = cells(std::ranges::min(y), std::ranges::max(y), rows);
    if (left == right || top == bottom) continue;
    const auto inside = barycentric(x, y);
    const Plane near = sum(inside, nearness[0], nearness[1], nearness[2]);
    for (int j = top; j < bottom; ++j) {
      const double shift = row_shift[j];
      const std::size_t row = static_cast<std::size_t>(j) * columns;
      for (int i = left; i < right; ++i) {
        const double sx = i + shift, sy = j + column_shift[i];
        if (!(inside[0](sx, sy) >= 0.0 && inside[1](sx, sy) >= 0.0 && inside[2](sx, sy) >= 0.0)) continue;
        const float here = static_cast<float>(near(sx, sy));
        if (here > nearest[row + i]) {
          nearest[row + i] = here;
          seen[row + i] = static_cast<std::int32_t>(number);
        }
      }
    }
  }
  return seen;
}

namespace {

// Eight floats that the compiler keeps in one wide register or in two narrow ones.
constexpr int lanes = 8;
typedef float Lanes __attribute__((vector_size(lanes * sizeof(float))));

// sRGB to linear light, above the linear toe a polynomial.
#define RASTER_DECODED(c)           \
  ((c) <= 0.04045f                  \
       ? (c) * (1.0f / 12.92f)      \
       : 0.00101080102f +           \
             (c) * (0.0301503654f + \
                    (c) * (0.538876185f + (c) * (0.611357191f + (c) * (-0.241147234f + (c) * 0.0597738063f)))))

// One place on the textures.
struct Place {
  double u, v;
};

// Write to `sums` the sum of the textures over places, decoded.
RASTER_KERNEL void sum_lookups(const Textures& textures, const Place* places, int count, float* sums) {
  const int size = textures.size, channels = textures.channels;
  for (int first = 0; first < channels; first += lanes) {
    Lanes total = {};
    for (int p = 0; p < count; ++p) {
      const double x = std::min(std::max(places[p].u * size - 0.5, 0.0), size - 1.0);
      const double y = std::min(std::max(places[p].v * size - 0.5, 0.0), size - 1.0);
      const int i = std::min(static_cast<int>(x), size - 2), j = std::min(static_cast<int>(y), size - 2);
      const float fx = static_cast<float>(x - i), fy = static_cast<float>(y - j);
      const float* low = textures.texels.data() + (static_cast<std::size_t>(j) * size + i) * channels + first;
      const float* high = low + static_cast<std::size_t>(size) * channels;
      Lanes t00, t10, t01, t11;
      __builtin_memcpy(&t00, low, sizeof(Lanes));
      __builtin_memcpy(&t10, low + channels, sizeof(Lanes));
      __builtin_memcpy(&t01, high, sizeof(Lanes));
      __builtin_memcpy(&t11, high + channels, sizeof(Lanes));
      const Lanes lower = t00 + fx * (t10 - t00), upper = t01 + fx * (t11 - t01);
      const Lanes color = lower + fy * (upper - lower);
      total += RASTER_DECODED(color);
    }
    __builtin_memcpy(sums + first, &total, sizeof(Lanes));
  }
}

}  // namespace

float decoded(float srgb) { return RASTER_DECODED(srgb); }

Albedo albedo(std::span<const std::int32_t> seen, std::span<const Projected> vertices,
              std::span<const Triangle> triangles, std::span<const TextureCoordinate> coordinates, std::int32_t end,
              const Textures& textures, Window window, int grid) {
  const Samples samples(window, grid);
  const int columns = window.width * grid, colors = 3 * textures.count;
  const std::size_t pixels = static_cast<std::size_t>(window.width) * window.height;
  Albedo result{std::vector<float>(pixels), std::vector<float>(pixels * colors), std::vector<std::int32_t>(end)};
  // Texture coordinates over depth, and 1 / depth, are linear in the image.
  struct Lookup {
    Plane u, v, near;
  };
  std::vector<Lookup> lookups(end);
  for (std::int32_t number = 0; number < end; ++number) {
    const Triangle& triangle = triangles[number];
    const auto [x, y, q] = corners(samples, vertices, triangle);
    const auto inside = barycentric(x, y);
    const TextureCoordinate &a = coordinates[triangle.a], &b = coordinates[triangle.b], &c = coordinates[triangle.c];
    lookups[number] = {sum(inside, a.u * q[0], b.u * q[1], c.u * q[2]), sum(inside, a.v * q[0], b.v * q[1], c.v * q[2]),
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
          const double x = i + samples.shift(j), y = j + samples.shift(i), depth = 1.0 / lookup.near(x, y);
          places[count++] = {lookup.u(x, y) * depth, lookup.v(x, y) * depth};
        }
      }
      if (count == 0) continue;
      sum_lookups(textures, places.data(), count, sums.data());
      const std::size_t pixel = static_cast<std::size_t>(row) * window.width + column;
      result.coverage[pixel] = static_cast<float>(covered) / static_cast<float>(grid * grid);
      for (int color = 0; color < colors; ++color) result.mean[pixel * colors + color] = sums[color] / count;
    }
  }
  return result;
}

}  // namespace raster
