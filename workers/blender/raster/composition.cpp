#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdlib>

#include "raster.hpp"

namespace raster {

namespace {

constexpr int levels = 65536;  // of the table that encodes linear light

constexpr int fine = 256;  // parts of an 8-bit level

// Linear light as sRGB [IEC 61966-2-1], in parts of an 8-bit level.
const std::vector<std::uint16_t>& encoding() {
  static const std::vector<std::uint16_t> table = [] {
    std::vector<std::uint16_t> codes(levels);
    for (int k = 0; k < levels; ++k) {
      const double light = k / (levels - 1.0);
      const double srgb =
          light <= 0.0031308 ? 12.92 * light : 1.055 * std::pow(light, 1.0 / 2.4) - 0.055;
      codes[k] = static_cast<std::uint16_t>(std::lrint(fine * 255.0 * srgb));
    }
    return codes;
  }();
  return table;
}

int code(float light) {
  const float bounded = light > 0.0f ? (light < 1.0f ? light : 1.0f) : 0.0f;
  return static_cast<std::int32_t>(bounded * (levels - 1.0f) + 0.5f);
}

bool is_near(int exact, int level) { return std::abs(exact - fine * level) <= tolerance * fine; }

// Write a pixel near the exact values: it stays as it is where that is near. Else a colour takes
// the level of the one before it where that is near.
void settle(const std::uint16_t* exact, std::uint8_t* pixel) {
  if (is_near(exact[0], pixel[0]) && is_near(exact[1], pixel[1]) && is_near(exact[2], pixel[2]))
    return;
  for (int k = 0; k < 3; ++k)
    pixel[k] = k > 0 && is_near(exact[k], pixel[k - 1])
                   ? pixel[k - 1]
                   : static_cast<std::uint8_t>((exact[k] + fine / 2) / fine);
}

// A half float that is not NaN; infinity is 65536.
float single(std::uint16_t half) {
  const float magnitude =
      std::bit_cast<float>(static_cast<std::uint32_t>(half & 0x7fff) << 13) * 0x1p112f;
  return half & 0x8000 ? -magnitude : magnitude;
}

// Light as a function of the cloth's albedo.
struct Light {
  float gloss, once, twice;
};

// The light of a part of a pixel; sums of values have the sum of their lights. Off the cloth
// nothing is seen of its albedo.
Light solved(const Shading& shading, const std::array<float, 3>& at, bool is_cloth) {
  const float slope = (at[1] - at[2]) / (shading.usual - shading.dark),
              dark = at[1] - shading.usual * slope;
  if (!is_cloth) return {dark, slope, 0.0f};
  return {at[0], (dark - at[0]) / shading.shown, slope / shading.shown};
}

// Add to `sums` (once + twice * other) * albedo + gloss, where `cover` of it is cloth, and the rest
// times the floor's factor.
RASTER_KERNEL void add_up(const Light& light, float cover, const float* __restrict albedo,
                          const float* __restrict other, const float* __restrict floor,
                          float* __restrict sums, int count) {
  for (int k = 0; k < count; ++k)
    sums[k] += (light.gloss + (light.once + light.twice * other[k]) * albedo[k]) *
               (1.0f + (1.0f - cover) * (floor[k] - 1.0f));
}

// Where in a part of the frame a pixel is, or -1.
std::ptrdiff_t index_in(const Window& window, int column, int row) {
  const int x = column - window.left, y = row - window.top;
  if (x < 0 || y < 0 || x >= window.width || y >= window.height) return -1;
  return static_cast<std::ptrdiff_t>(y) * window.width + x;
}

}  // namespace

void compose(const Shading& shading, std::span<const float> overall, const Part& cloth,
             std::span<const float> coverage, const Part& reflected, std::span<const float> floor,
             std::uint8_t* pictures, std::size_t stride) {
  const std::vector<std::uint16_t>& table = encoding();
  const int colors = static_cast<int>(overall.size()), fine = shading.fine;
  const float part = 1.0f / static_cast<float>(fine * fine);
  std::vector<float> factor(colors), sums(colors);
  std::vector<std::int32_t> codes(colors);
  for (int row = 0; row < shading.height; ++row) {
    for (int column = 0; column < shading.width; ++column) {
      const std::size_t pixel = static_cast<std::size_t>(row) * shading.width + column;
      const std::ptrdiff_t there = index_in(reflected.window, column, row);
      const float* const around =
          there < 0 ? overall.data() : reflected.albedo.data() + there * colors;
      for (int k = 0; k < colors; ++k) factor[k] = floor[3 * pixel + k % 3];
      std::fill(sums.begin(), sums.end(), 0.0f);
      std::array<float, 3> mean{};  // of the parts without cloth, which have one albedo
      bool bare = false;
      for (int y = fine * row; y < fine * (row + 1); ++y) {
        for (int x = fine * column; x < fine * (column + 1); ++x) {
          const std::uint16_t* const light =
              shading.light.data() + 3 * (static_cast<std::size_t>(y) * fine * shading.width + x);
          const std::array<float, 3> at{single(light[0]), single(light[1]), single(light[2])};
          const std::ptrdiff_t here = index_in(cloth.window, x, y);
          const float cover = here < 0 ? 0.0f : coverage[here];
          if (cover <= 0.0f) {
            for (int k = 0; k < 3; ++k) mean[k] += at[k];
            bare = true;
            continue;
          }
          const float* const seen = cloth.albedo.data() + here * colors;
          add_up(solved(shading, at, true), cover, seen, overall.data(), factor.data(), sums.data(),
                 colors);
        }
      }
      if (bare)
        add_up(solved(shading, mean, false), 0.0f, around, overall.data(), factor.data(),
               sums.data(), colors);
      for (int k = 0; k < colors; ++k) codes[k] = code(part * sums[k]);
      std::uint8_t* out = pictures + 3 * pixel;
      for (int k = 0; k < colors; k += 3, out += stride) {
        const std::array<std::uint16_t, 3> exact{table[codes[k]], table[codes[k + 1]],
                                                 table[codes[k + 2]]};
        settle(exact.data(), out);
      }
    }
  }
}

namespace {

// A line of a table that lies between two of its own: (1 - share) table[low] + share table[low +
// 1].
struct Between {
  std::size_t low;
  double share;
};

Between between(double place, int count) {
  const double inside = std::min(std::max(place, 0.0), static_cast<double>(count));
  const int low = std::min(static_cast<int>(inside), count - 1);
  return {static_cast<std::size_t>(low), inside - low};
}

// Add `sign` times the table, taken between its lines and columns, to `sums`.
RASTER_KERNEL void add_corner(const double* __restrict table, std::size_t row_step, int count,
                              Between row, Between column, double sign, double* __restrict sums) {
  const double* const __restrict at = table + row.low * row_step + column.low * count;
  const double* const __restrict below = at + row_step;
  const double d = sign * row.share, c = column.share;
  const double w00 = (sign - d) * (1.0 - c), w01 = (sign - d) * c, w10 = d * (1.0 - c), w11 = d * c;
  for (int k = 0; k < count; ++k)
    sums[k] += w00 * at[k] + w01 * at[k + count] + w10 * below[k] + w11 * below[k + count];
}

}  // namespace

std::vector<float> blurred(std::span<const float> values, std::span<const float> down,
                           std::span<const float> across, int width, int height, int count) {
  const std::size_t row_step = static_cast<std::size_t>(width + 1) * count;
  std::vector<double> table(row_step * (height + 1), 0.0), sums(count);
  std::vector<float> result(values.begin(), values.end());
  for (int pass = 0; pass < 2; ++pass) {
    for (int row = 0; row < height; ++row) {
      std::fill(sums.begin(), sums.end(), 0.0);
      const float* from = result.data() + static_cast<std::size_t>(row) * width * count;
      const double* above = table.data() + row * row_step + count;
      double* here = table.data() + (row + 1) * row_step + count;
      for (int column = 0; column < width; ++column, from += count, above += count, here += count) {
        for (int k = 0; k < count; ++k) {
          sums[k] += from[k];
          here[k] = above[k] + sums[k];
        }
      }
    }
    for (int row = 0; row < height; ++row) {
      for (int column = 0; column < width; ++column) {
        const std::size_t pixel = static_cast<std::size_t>(row) * width + column;
        const double half_down = std::sqrt(0.25 + down[pixel] * down[pixel]);
        const double half_across = std::sqrt(0.25 + across[pixel] * across[pixel]);
        const Between top = between(row + 0.5 - half_down, height),
                      bottom = between(row + 0.5 + half_down, height);
        const Between left = between(column + 0.5 - half_across, width),
                      right = between(column + 0.5 + half_across, width);
        std::fill(sums.begin(), sums.end(), 0.0);
        add_corner(table.data(), row_step, count, bottom, right, 1.0, sums.data());
        add_corner(table.data(), row_step, count, top, right, -1.0, sums.data());
        add_corner(table.data(), row_step, count, bottom, left, -1.0, sums.data());
        add_corner(table.data(), row_step, count, top, left, 1.0, sums.data());
        const double area = 4.0 * half_down * half_across;
        for (int k = 0; k < count; ++k)
          result[pixel * count + k] = static_cast<float>(sums[k] / area);
      }
    }
  }
  return result;
}

std::vector<double> normals(std::span<const double> points, std::span<const Triangle> triangles) {
  std::vector<double> sums(points.size(), 0.0);
  for (const Triangle& triangle : triangles) {
    const double *const a = points.data() + 3 * triangle.a,
                        *const b = points.data() + 3 * triangle.b,
                        *const c = points.data() + 3 * triangle.c;
    std::array<double, 3> p, q;
    for (int k = 0; k < 3; ++k) {
      p[k] = b[k] - a[k];
      q[k] = c[k] - a[k];
    }
    for (int k = 0; k < 3; ++k) {
      const int i = (k + 1) % 3, j = (k + 2) % 3;
      const double part = p[i] * q[j] - p[j] * q[i];
      for (const std::int32_t vertex : {triangle.a, triangle.b, triangle.c})
        sums[3 * vertex + k] += part;
    }
  }
  for (std::size_t n = 0; n < sums.size(); n += 3) {
    const double length =
        std::sqrt(sums[n] * sums[n] + sums[n + 1] * sums[n + 1] + sums[n + 2] * sums[n + 2]);
    if (length > 0.0)
      for (int k = 0; k < 3; ++k) sums[n + k] /= length;
  }
  return sums;
}

}  // namespace raster
