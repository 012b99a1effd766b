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

// ---- Visibility and albedo
// -----------------------------------------------------------------------

// A part of the image: `width` columns from `left` on, `height` rows from `top` on [px].
struct Window {
  int left;
  int top;
  int width;
  int height;
};

struct Triangle {
  std::int32_t a;
  std::int32_t b;
  std::int32_t c;
};

// A vertex in the image.
struct Projected {
  double u;      // column [px]
  double v;      // row [px]
  double depth;  // along the optical axis, above zero [scene units]
};

struct Mesh {
  std::span<const Projected> vertices;
  std::span<const Triangle> triangles;
};

struct TextureCoordinate {
  double u;
  double v;
};

// Textures of one size, texel by texel: texels[(row size + column) channels + 3 n + colour], sRGB
// in [0, 1].
struct Textures {
  std::span<const float> texels;
  int size;
  int channels;  // 3 for each texture, rounded up to a multiple of 8
  int count;
};

// Return the triangle seen at each sample, row by row, (grid height) x (grid width); -1 if there is
// none. The nearest triangle wins, and of two at the same depth the first.
std::vector<std::int32_t> visible(Mesh mesh, Window window, int grid);

// The triangles that `visible` found.
struct VisibleTriangles {
  std::span<const std::int32_t> numbers;  // of the triangle that each sample sees, or -1
  Window window;
  int grid;
};

// What the pixels of a window see of the triangles before `end`; those from `end` on only hide.
struct Albedo {
  // Share of a pixel's samples that see a triangle, height x width.
  std::vector<float> coverage;
  // Linear, of the samples that see a triangle, height x width x count x 3; 0 elsewhere.
  std::vector<float> mean;
  // Samples that see each triangle before `end`.
  std::vector<std::int32_t> hits;
  // Mean over the window, count x 3.
  std::vector<float> overall;
  // Area of all triangles before `end`, each seen alone [pixels].
  double area = 0.0;
};

// Mean the textures over what is visible. A texture is looked up as Cycles does it: bilinear
// between texel centres in sRGB, clamped at the border, then decoded to linear light; texture
// coordinates are interpolated in perspective. Of a pixel's samples that see a triangle the first,
// and then those of a checkerboard, are looked up.
Albedo albedo(const VisibleTriangles& visible, Mesh mesh,
              std::span<const TextureCoordinate> coordinates, std::int32_t end,
              const Textures& textures);

// sRGB in [0, 1] to linear light [IEC 61966-2-1], by a polynomial that is within 2.2e-5.
float decoded(float srgb);

// ---- Composition
// ---------------------------------------------------------------------------------
//
// Pictures of many textures from one shading, and marks of the floor: the formula stands in
// stickslip_blender.cloth.shading.

// The light of a frame at three albedos of the cloth: as the camera sees it 0, `camera` and
// `camera`, for all other light `bright`, `bright` and `dark`.
struct Shading {
  std::span<const std::uint16_t> light;  // half floats, (fine height) x (fine width) x 3
  int width;                             // of a picture
  int height;
  int fine;  // pixels of the light across one of a picture, and down
  float camera;
  float bright;
  float dark;
};

// Albedos in a part of the frame, height x width x colours; texture n has the colours 3 n to 3 n
// + 2.
struct Part {
  Window window;
  std::span<const float> albedo;
};

// The parts of a frame that the textures of the cloth and the marks of the floor change.
struct Layers {
  // Albedo (colours) of light that met the cloth elsewhere.
  std::span<const float> overall;
  // Cloth, in pixels of the light. Its window has whole pixels of a picture: a print and a fold
  // that meet in a pixel have light of their own. A pixel is the mean of its parts.
  Part cloth;
  // Share of the pixels of the cloth's window that see cloth.
  std::span<const float> coverage;
  // The cloth that the floor shows in its window, instead of `overall`.
  Part reflected;
  // Factor of the floor's light, height x width x 3.
  std::span<const float> floor;
};

// Pictures of colours / 3 textures, height x width x 3 each and `stride` bytes apart, 8-bit sRGB.
struct Pictures {
  std::uint8_t* pixels;
  std::size_t stride;
};

// Write pictures, which hold the frame before, or zeros.
void compose(const Shading& shading, const Layers& layers, Pictures pictures);

// Largest difference of a pixel of a clip from its exact value [8-bit levels]. A pixel stays as it
// was in the frame before where all colours are as near as this. Else red is rounded; green takes
// the level of red, and blue that of green, where it is as near, or is rounded. What stays, and
// grey that stays grey, is smaller when coded.
constexpr int tolerance = 1;

// ---- Filters
// -------------------------------------------------------------------------------------

// Values at pixels, height x width x count.
struct Image {
  std::span<const float> values;
  int width;
  int height;
  int count;
};

// Return the values of an image, blurred about each pixel by radii of its own, in rows `down` and
// in columns `across` [px], not necessarily whole: twice the mean over a box, from a summed-area
// table [Crow 1984]. A side of a box is sqrt(1 + 4 radius^2): its variance is that of a pixel and
// radius^2 / 3. There are zeros around the values.
std::vector<float> blurred(const Image& image, std::span<const float> down,
                           std::span<const float> across);

// Return the normals of vertices, of length 1: sums of the normals of their triangles, weighted by
// area.
std::vector<double> normals(std::span<const double> points, std::span<const Triangle> triangles);

}  // namespace raster
