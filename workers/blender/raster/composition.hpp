// Pictures of many textures from one shading, and marks of the floor. The formula stands in
// stickslip_blender.cloth.shading.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "raster.hpp"

namespace raster {

// The light of a frame at three albedos of the cloth: as the camera sees it 0, `shown` and `shown`, for all other light
// `usual`, `usual` and `dark`.
struct Shading {
  std::span<const std::uint16_t> light;  // half floats, (fine height) x (fine width) x 3
  int width, height;                     // of a picture
  int fine;                              // pixels of the light across one of a picture, and down
  float shown, usual, dark;
};

// Albedos in a part of the frame, height x width x colours; texture n has the colours 3 n to 3 n + 2.
struct Part {
  Window window;
  std::span<const float> albedo;
};

// Write pictures of colours / 3 textures, height x width x 3 each and `stride` bytes apart, 8-bit sRGB. They hold the
// frame before, or zeros.
//
// `cloth` and `coverage` are in pixels of the light, and their window has whole pixels of a picture: a print and a fold
// that meet in a pixel have light of their own. A pixel is the mean of its parts.
// `coverage` is the share of the pixels of the cloth's window that see cloth. `overall` is the albedo (colours) of
// light that met the cloth elsewhere; `reflected` what the floor shows of the cloth in its window, instead of it.
// `floor` (height x width x 3) is a factor of the floor's light.
void compose(const Shading& shading, std::span<const float> overall, const Part& cloth, std::span<const float> coverage,
             const Part& reflected, std::span<const float> floor, std::uint8_t* pictures, std::size_t stride);

// Largest difference of a pixel of a clip from its exact value [8-bit levels]. A pixel stays as it was in the frame
// before where all colours are as near as this. Else red is rounded; green takes the level of red, and blue that of
// green, where it is as near, or is rounded. What stays, and grey that stays grey, is smaller when coded.
constexpr int tolerance = 1;

// Return values (height x width x count), blurred about each pixel by radii of its own, in rows `down` and in columns
// `across` [px], not necessarily whole: twice the mean over a box, from a summed-area table [Crow 1984]. A side of a
// box is sqrt(1 + 4 radius^2): its variance is that of a pixel and radius^2 / 3. There are zeros around the values.
std::vector<float> blurred(std::span<const float> values, std::span<const float> down, std::span<const float> across,
                           int width, int height, int count);

// Return the normals of vertices, of length 1: sums of the normals of their triangles, weighted by area.
std::vector<double> normals(std::span<const double> points, std::span<const Triangle> triangles);

}  // namespace raster
