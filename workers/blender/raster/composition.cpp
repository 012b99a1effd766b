#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdlib>

#include "raster.hpp"

namespace raster {

namespace {

constexpr int code_count = 65536;  // of the table that encodes linear light

constexpr int level_parts = 256;  // parts of an 8-bit level

double encoded(double light) {
  if (light <= 0.0031308) return 12.92 * light;
  return 1.055 * std::pow(light, 1.0 / 2.4) - 0.055;
}

// Linear light as sRGB [IEC 61966-2-1], in parts of an 8-bit level.
const std::vector<std::uint16_t>& encoding() {
  static const std::vector<std::uint16_t> table = [] {
    std::vector<std::uint16_t> codes(code_count);
    for (int k = 0; k < code_count; ++k) {
      const double srgb = encoded(k / (code_count - 1.0));
      codes[k] = static_cast<std::uint16_t>(std::lrint(level_parts * 255.0 * srgb));
    }
    return codes;
  }();
  return table;
}

int code_of(float light) {
  const float bounded = light > 0.0f ? (light < 1.0f ? light : 1.0f) : 0.0f;
  return static_cast<std::int32_t>(bounded * (code_count - 1.0f) + 0.5f);
}

bool is_near(int exact, int level) {
  return std::abs(exact - level_parts * level) <= tolerance * level_parts;
}

// Write a pixel near the exact values: it stays as it is where that is near. Else a colour takes
// the level of the one before it where that is near.
void write_pixel(const std::array<std::uint16_t, 3>& exact, std::uint8_t* pixel) {
  if (is_near(exact[0], pixel[0]) && is_near(exact[1], pixel[1]) && is_near(exact[2], pixel[2])) {
    return;
  }
  for (int k = 0; k < 3; ++k) {
    if (k > 0 && is_near(exact[k], pixel[k - 1])) {
      pixel[k] = pixel[k - 1];
    } else {
      pixel[k] = static_cast<std::uint8_t>((exact[k] + level_parts / 2) / level_parts);
    }
  }
}

// A half float that is not NaN; infinity is 65536.
float single(std::uint16_t half) {
  const auto bits = static_cast<std::uint32_t>(half & 0x7fff) << 13;
  const float magnitude = std::bit_cast<float>(bits) * 0x1p112f;
  return half & 0x8000 ? -magnitude : magnitude;
}

using Sight = std::array<float, 3>;  // light at three albedos

// Light as a function of the cloth's albedo.
struct Light {
  float gloss;
  float once;
  float twice;
};

// The light of a part of a pixel; sums of values have the sum of their lights.
Light light_of_cloth(const Shading& shading, const Sight& at) {
  const float slope = (at[1] - at[2]) / (shading.bright - shading.dark);
  const float dark = at[1] - shading.bright * slope;
  return {at[0], (dark - at[0]) / shading.camera, slope / shading.camera};
}

// Off the cloth nothing is seen of its albedo.
Light light_of_floor(const Shading& shading, const Sight& at) {
  const float slope = (at[1] - at[2]) / (shading.bright - shading.dark);
  const float dark = at[1] - shading.bright * slope;
  return {dark, slope, 0.0f};
}

// Add to `sums` (once + twice * other) * albedo + gloss, where `cover` of it is cloth, and the rest
// times the floor's factor.
RASTER_KERNEL void add_light(const Light& light, float cover, const float* __restrict albedo,
                             const float* __restrict other, const float* __restrict floor,
                             float* __restrict sums, int count) {
  for (int k = 0; k < count; ++k) {
    sums[k] += (light.gloss + (light.once + light.twice * other[k]) * albedo[k]) *
               (1.0f + (1.0f - cover) * (floor[k] - 1.0f));
  }
}

// The index of a pixel in a part of the frame, or -1.
std::ptrdiff_t index_in(const Window& window, int column, int row) {
  const int x = column - window.left;
  const int y = row - window.top;
  if (x < 0 || y < 0 || x >= window.width || y >= window.height) return -1;
  return static_cast<std::ptrdiff_t>(y) * window.width + x;
}

// Adds up the light of a pixel of the pictures, in all colours at once.
class PixelComposer {
 public:
  PixelComposer(const Shading& shading, const Layers& layers)
      : shading_(shading),
        layers_(layers),
        colors_(static_cast<int>(layers.overall.size())),
        factor_(colors_),
        sums_(colors_),
        codes_(colors_) {}

  // Return the linear light of the pixel in a column and a row, as indices of the encoding.
  std::span<const std::int32_t> compose(int column, int row) {
    const std::size_t pixel = static_cast<std::size_t>(row) * shading_.width + column;
    for (int k = 0; k < colors_; ++k) {
      factor_[k] = layers_.floor[3 * pixel + k % 3];
    }
    std::fill(sums_.begin(), sums_.end(), 0.0f);
    // The parts without cloth have one albedo, so their light is added once.
    Sight bare{};
    bool has_bare = false;
    const int fine = shading_.fine;
    for (int y = fine * row; y < fine * (row + 1); ++y) {
      for (int x = fine * column; x < fine * (column + 1); ++x) {
        const Sight at = light_at(x, y);
        const std::ptrdiff_t index = index_in(layers_.cloth.window, x, y);
        const float cover = index < 0 ? 0.0f : layers_.coverage[index];
        if (cover > 0.0f) {
          const float* const albedo = layers_.cloth.albedo.data() + index * colors_;
          add(light_of_cloth(shading_, at), cover, albedo);
          continue;
        }
        for (int k = 0; k < 3; ++k) {
          bare[k] += at[k];
        }
        has_bare = true;
      }
    }
    if (has_bare) add(light_of_floor(shading_, bare), 0.0f, around(column, row));
    const float part = 1.0f / static_cast<float>(fine * fine);
    for (int k = 0; k < colors_; ++k) {
      codes_[k] = code_of(part * sums_[k]);
    }
    return codes_;
  }

 private:
  Sight light_at(int x, int y) const {
    const std::size_t width = static_cast<std::size_t>(shading_.fine) * shading_.width;
    const std::uint16_t* const light = shading_.light.data() + 3 * (y * width + x);
    return {single(light[0]), single(light[1]), single(light[2])};
  }

  // The albedo of cloth that the floor shows at a pixel.
  const float* around(int column, int row) const {
    const std::ptrdiff_t index = index_in(layers_.reflected.window, column, row);
    if (index < 0) return layers_.overall.data();
    return layers_.reflected.albedo.data() + index * colors_;
  }

  void add(const Light& light, float cover, const float* albedo) {
    const float* const other = layers_.overall.data();
    add_light(light, cover, albedo, other, factor_.data(), sums_.data(), colors_);
  }

  const Shading& shading_;
  const Layers& layers_;
  int colors_;
  std::vector<float> factor_;
  std::vector<float> sums_;
  std::vector<std::int32_t> codes_;
};

}  // namespace

void compose(const Shading& shading, const Layers& layers, Pictures pictures) {
  const std::vector<std::uint16_t>& table = encoding();
  PixelComposer composer(shading, layers);
  for (int row = 0; row < shading.height; ++row) {
    for (int column = 0; column < shading.width; ++column) {
      const std::span<const std::int32_t> codes = composer.compose(column, row);
      const std::size_t pixel = static_cast<std::size_t>(row) * shading.width + column;
      std::uint8_t* out = pictures.pixels + 3 * pixel;
      for (std::size_t k = 0; k < codes.size(); k += 3) {
        const std::array<std::uint16_t, 3> exact{table[codes[k]], table[codes[k + 1]],
                                                 table[codes[k + 2]]};
        write_pixel(exact, out);
        out += pictures.stride;
      }
    }
  }
}

}  // namespace raster
