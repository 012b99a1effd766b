// Which triangle is seen at each of many samples a pixel, and the mean albedo that a pixel then has.
//
// Image coordinates are those of stickslip_schemas.spec.cameras: integer pixel coordinates are pixel centres. A pixel
// has grid x grid samples, one in each of as many cells; inside its cell a sample sits at
//
//     x = ((5 j mod grid) + 1/2) / grid,   y = ((5 i mod grid) + 1/2) / grid      cell (i, j) = (column, row)
//
// so that the grid^2 samples of a pixel have that many different columns and rows [multi-jittered, Chiu et al. 1994].
// A grid of 1 has its sample in the middle of the pixel.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

namespace raster {

// A part of the image: `width` columns from `left` on, `height` rows from `top` on [px].
struct Window {
  int left, top, width, height;
};

struct Triangle {
  std::int32_t a, b, c;
};

// Where a vertex is seen: column and row [px], depth along the optical axis [scene units], above zero.
struct Projected {
  double u, v, depth;
};

struct TextureCoordinate {
  double u, v;
};

// Textures of one size, texel by texel: texels[(row size + column) channels + 3 n + colour], sRGB in [0, 1]. `channels`
// is 3 per texture, rounded up to a multiple of 8.
struct Textures {
  std::span<const float> texels;
  int size, channels, count;
};

// Return the triangle seen at each sample, row by row, (grid height) x (grid width); -1 if there is none. The
// nearest triangle wins, and of two at the same depth the first.
std::vector<std::int32_t> visible(std::span<const Projected> vertices, std::span<const Triangle> triangles,
                                  Window window, int grid);

// What the pixels of a window see of the triangles before `end`; those from `end` on only hide.
struct Albedo {
  std::vector<float> coverage;  // share of a pixel's samples, (height) x (width)
  std::vector<float> mean;      // linear, of the samples that see a triangle, height x width x count x 3; 0 elsewhere
  std::vector<std::int32_t> hits;  // samples that see each triangle before `end`
  std::vector<float> overall;      // mean over the window, count x 3
  double area;                     // of all triangles before `end`, each seen alone [pixels]
};

// Mean the textures over what is visible. A texture is looked up as Cycles does it: bilinear between texel centres in
// sRGB, clamped at the border, then decoded to linear light; texture coordinates are interpolated in perspective. Of a
// pixel's samples that see a triangle the first, and then those of a checkerboard, are looked up.
Albedo albedo(std::span<const std::int32_t> seen, std::span<const Projected> vertices,
              std::span<const Triangle> triangles, std::span<const TextureCoordinate> coordinates, std::int32_t end,
              const Textures& textures, Window window, int grid);

// sRGB in [0, 1] to linear light [IEC 61966-2-1], by a polynomial that is within 2.2e-5.
float decoded(float srgb);

}  // namespace raster
