// Which triangle is seen at each of many samples a pixel, and the mean albedo that a pixel then
// has.
//
// Image coordinates are those of stickslip_schemas.spec.cameras: integer pixel coordinates are
// pixel centres. A pixel has grid x grid samples, one in each of as many cells; inside its cell a
// sample sits at
//
//     x = ((5 j mod grid) + 1/2) / grid,   y = ((5 i mod grid) + 1/2) / grid      cell (i, j) =
//     (column, row)
//
// so that the grid^2 samples of a pixel have that many different columns and rows [multi-jittered,
// Chiu et al. 1994]. A grid of 1 has its sample in the middle of the pixel.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

// Wider vectors where the processor has them. Nothing is contracted or reordered, so all versions
// give the same bits.
//
// Loops in a kernel are plain ones over arrays: the compiler makes vectors of them. Of vector types
// it makes scalars where a function has several versions.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define RASTER_KERNEL __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define RASTER_KERNEL
#endif

namespace raster {

// A part of the image: `width` columns from `left` on, `height` rows from `top` on [px].
struct Window {
  int left, top, width, height;
};

struct Triangle {
  std::int32_t a, b, c;
};

// Where a vertex is seen: column and row [px], depth along the optical axis [scene units], above
// zero.
struct Projected {
  double u, v, depth;
};

struct TextureCoordinate {
  double u, v;
};

// Textures of one size, texel by texel: texels[(row size + column) channels + 3 n + colour], sRGB
// in [0, 1]. `channels` is 3 per texture, rounded up to a multiple of 8.
struct Textures {
  std::span<const float> texels;
  int size, channels, count;
};

// Return the triangle seen at each sample, row by row, (grid height) x (grid width); -1 if there is
// none. The nearest triangle wins, and of two at the same depth the first.
std::vector<std::int32_t> visible(std::span<const Projected> vertices,
                                  std::span<const Triangle> triangles, Window window, int grid);

// What the pixels of a window see of the triangles before `end`; those from `end` on only hide.
struct Albedo {
  std::vector<float> coverage;  // share of a pixel's samples, (height) x (width)
  std::vector<float>
      mean;  // linear, of the samples that see a triangle, height x width x count x 3; 0 elsewhere
  std::vector<std::int32_t> hits;  // samples that see each triangle before `end`
  std::vector<float> overall;      // mean over the window, count x 3
  double area;                     // of all triangles before `end`, each seen alone [pixels]
};

// Mean the textures over what is visible. A texture is looked up as Cycles does it: bilinear
// between texel centres in sRGB, clamped at the border, then decoded to linear light; texture
// coordinates are interpolated in perspective. Of a pixel's samples that see a triangle the first,
// and then those of a checkerboard, are looked up.
Albedo albedo(std::span<const std::int32_t> seen, std::span<const Projected> vertices,
              std::span<const Triangle> triangles, std::span<const TextureCoordinate> coordinates,
              std::int32_t end, const Textures& textures, Window window, int grid);

// sRGB in [0, 1] to linear light [IEC 61966-2-1], by a polynomial that is within 2.2e-5.
float decoded(float srgb);

// Pictures of many textures from one shading, and marks of the floor: the formula stands in
// stickslip_blender.cloth.shading.

// The light of a frame at three albedos of the cloth: as the camera sees it 0, `shown` and `shown`,
// for all other light `usual`, `usual` and `dark`.
struct Shading {
  std::span<const std::uint16_t> light;  // half floats, (fine height) x (fine width) x 3
  int width, height;                     // of a picture
  int fine;                              // pixels of the light across one of a picture, and down
  float shown, usual, dark;
};

// Albedos in a part of the frame, height x width x colours; texture n has the colours 3 n to 3 n
// + 2.
struct Part {
  Window window;
  std::span<const float> albedo;
};

// Write pictures of colours / 3 textures, height x width x 3 each and `stride` bytes apart, 8-bit
// sRGB. They hold the frame before, or zeros.
//
// `cloth` and `coverage` are in pixels of the light, and their window has whole pixels of a
// picture: a print and a fold that meet in a pixel have light of their own. A pixel is the mean of
// its parts. `coverage` is the share of the pixels of the cloth's window that see cloth. `overall`
// is the albedo (colours) of light that met the cloth elsewhere; `reflected` what the floor shows
// of the cloth in its window, instead of it. `floor` (height x width x 3) is a factor of the
// floor's light.
void compose(const Shading& shading, std::span<const float> overall, const Part& cloth,
             std::span<const float> coverage, const Part& reflected, std::span<const float> floor,
             std::uint8_t* pictures, std::size_t stride);

// Largest difference of a pixel of a clip from its exact value [8-bit levels]. A pixel stays as it
// was in the frame before where all colours are as near as this. Else red is rounded; green takes
// the level of red, and blue that of green, where it is as near, or is rounded. What stays, and
// grey that stays grey, is smaller when coded.
constexpr int tolerance = 1;

// Return values (height x width x count), blurred about each pixel by radii of its own, in rows
// `down` and in columns `across` [px], not necessarily whole: twice the mean over a box, from a
// summed-area table [Crow 1984]. A side of a box is sqrt(1 + 4 radius^2): its variance is that of a
// pixel and radius^2 / 3. There are zeros around the values.
std::vector<float> blurred(std::span<const float> values, std::span<const float> down,
                           std::span<const float> across, int width, int height, int count);

// Return the normals of vertices, of length 1: sums of the normals of their triangles, weighted by
// area.
std::vector<double> normals(std::span<const double> points, std::span<const Triangle> triangles);

}  // namespace raster
