#include <algorithm>
#include <array>
#include <cmath>

#include "raster.hpp"
#include "samples.hpp"

namespace raster {

namespace {

constexpr int lanes = 8;  // channels that are looked up together

// sRGB to linear light, above the linear toe a polynomial. A macro, since a kernel with several
// versions inlines no function.
#define RASTER_DECODED(c)                 \
  ((c) <= 0.04045f                        \
       ? (c) * (1.0f / 12.92f)            \
       : 0.00101080102f +                 \
             (c) * (0.0301503654f +       \
                    (c) * (0.538876185f + \
                           (c) * (0.611357191f + (c) * (-0.241147234f + (c) * 0.0597738063f)))))

// A position on the textures: the texel before it, in its row and column, and the distance from
// there in texels.
struct TexelPosition {
  std::uint32_t texel;
  float along;
  float down;
};

TexelPosition find_texel(const Textures& textures, double u, double v) {
  const int size = textures.size;
  // Texel centres lie at halves, and the border is clamped.
  const double x = std::min(std::max(u * size - 0.5, 0.0), size - 1.0);
  const double y = std::min(std::max(v * size - 0.5, 0.0), size - 1.0);
  // The last texel has none after it.
  const int column = std::min(static_cast<int>(x), size - 2);
  const int row = std::min(static_cast<int>(y), size - 2);
  return {static_cast<std::uint32_t>(row) * size + column, static_cast<float>(x - column),
          static_cast<float>(y - row)};
}

// Write to `sums` the sum of the textures over positions, decoded.
RASTER_KERNEL void sum_lookups(const Textures& textures, const TexelPosition* positions, int count,
                               float* __restrict sums) {
  const int channels = textures.channels;
  const std::size_t right = channels;
  const std::size_t below = static_cast<std::size_t>(textures.size) * channels;
  std::fill_n(sums, channels, 0.0f);
  for (int p = 0; p < count; ++p) {
    const float along = positions[p].along;
    const float down = positions[p].down;
    const float* const __restrict texel = textures.texels.data() + positions[p].texel * right;
    for (int first = 0; first < channels; first += lanes) {
      const float* const __restrict corner = texel + first;
      float* const __restrict sum = sums + first;
      for (int k = 0; k < lanes; ++k) {
        const float t00 = corner[k];
        const float t10 = corner[k + right];
        const float t01 = corner[k + below];
        const float t11 = corner[k + below + right];
        const float upper = t00 + along * (t10 - t00);
        const float lower = t01 + along * (t11 - t01);
        const float color = upper + down * (lower - upper);
        sum[k] += RASTER_DECODED(color);
      }
    }
  }
}

// Texture coordinates over depth, and 1 / depth, of a triangle: all three are linear in the image.
struct Lookup {
  Plane u;
  Plane v;
  Plane nearness;
};

Lookup lookup_of(const Corners& corners, const Triangle& triangle,
                 std::span<const TextureCoordinate> coordinates) {
  const std::array<Plane, 3> inside = corners.barycentric();
  const auto& q = corners.nearness;
  const TextureCoordinate& a = coordinates[triangle.a];
  const TextureCoordinate& b = coordinates[triangle.b];
  const TextureCoordinate& c = coordinates[triangle.c];
  return {interpolate(inside, a.u * q[0], b.u * q[1], c.u * q[2]),
          interpolate(inside, a.v * q[0], b.v * q[1], c.v * q[2]),
          interpolate(inside, q[0], q[1], q[2])};
}

// Finds the positions on the textures that the samples of a pixel see.
class PixelSampler {
 public:
  PixelSampler(const VisibleTriangles& visible, const Textures& textures, const Samples& samples,
               int columns)
      : visible_(visible), textures_(textures), samples_(samples), columns_(columns) {
    positions_.resize(static_cast<std::size_t>(visible.grid) * visible.grid);
  }

  // Find the positions of the pixel in a column and a row, and count the hits of each triangle.
  void sample(int column, int row, std::span<const Lookup> lookups, std::span<std::int32_t> hits) {
    const int grid = visible_.grid;
    const auto end = static_cast<std::int32_t>(lookups.size());
    count_ = 0;
    covered_ = 0;
    for (int j = row * grid; j < (row + 1) * grid; ++j) {
      for (int i = column * grid; i < (column + 1) * grid; ++i) {
        const std::int32_t number = visible_.numbers[static_cast<std::size_t>(j) * columns_ + i];
        if (number < 0 || number >= end) continue;
        ++hits[number];
        ++covered_;
        // After the first sample, those of a checkerboard are enough.
        if (count_ > 0 && (i + j) % 2 != 0) continue;
        positions_[count_++] = position_of(lookups[number], i, j);
      }
    }
  }

  const TexelPosition* positions() const { return positions_.data(); }
  int count() const { return count_; }      // of the positions
  int covered() const { return covered_; }  // samples that see a triangle

 private:
  TexelPosition position_of(const Lookup& lookup, int i, int j) const {
    const double x = i + samples_.shift(j);
    const double y = j + samples_.shift(i);
    const double depth = 1.0 / lookup.nearness(x, y);
    return find_texel(textures_, lookup.u(x, y) * depth, lookup.v(x, y) * depth);
  }

  const VisibleTriangles& visible_;
  const Textures& textures_;
  const Samples& samples_;
  int columns_;
  std::vector<TexelPosition> positions_;
  int count_ = 0;
  int covered_ = 0;
};

}  // namespace

float decoded(float srgb) { return RASTER_DECODED(srgb); }

Albedo albedo(const VisibleTriangles& visible, Mesh mesh,
              std::span<const TextureCoordinate> coordinates, std::int32_t end,
              const Textures& textures) {
  const Window window = visible.window;
  const int grid = visible.grid;
  const Samples samples(window, grid);
  const int colors = 3 * textures.count;
  const std::size_t pixels = static_cast<std::size_t>(window.width) * window.height;
  Albedo result;
  result.coverage.resize(pixels);
  result.mean.resize(pixels * colors);
  result.hits.resize(end);
  result.overall.resize(colors);

  std::vector<Lookup> lookups;
  lookups.reserve(end);
  for (const Triangle& triangle : mesh.triangles.first(end)) {
    const Corners corners = project(samples, mesh.vertices, triangle);
    lookups.push_back(lookup_of(corners, triangle, coordinates));
    // Cells to pixels.
    result.area += 0.5 * std::abs(corners.doubled_area()) / (grid * grid);
  }

  PixelSampler sampler(visible, textures, samples, window.width * grid);
  std::vector<float> sums(textures.channels);
  std::vector<double> weighted(colors, 0.0);
  double weight = 0.0;
  for (int row = 0; row < window.height; ++row) {
    for (int column = 0; column < window.width; ++column) {
      sampler.sample(column, row, lookups, result.hits);
      if (sampler.count() == 0) continue;
      sum_lookups(textures, sampler.positions(), sampler.count(), sums.data());
      const std::size_t pixel = static_cast<std::size_t>(row) * window.width + column;
      const auto covered = static_cast<float>(sampler.covered());
      result.coverage[pixel] = covered / static_cast<float>(grid * grid);
      weight += sampler.covered();
      for (int color = 0; color < colors; ++color) {
        const float mean = sums[color] / sampler.count();
        result.mean[pixel * colors + color] = mean;
        // Each pixel counts with its cloth in the mean over the window.
        weighted[color] += sampler.covered() * static_cast<double>(mean);
      }
    }
  }
  if (weight > 0.0) {
    for (int color = 0; color < colors; ++color) {
      result.overall[color] = static_cast<float>(weighted[color] / weight);
    }
  }
  return result;
}

}  // namespace raster
