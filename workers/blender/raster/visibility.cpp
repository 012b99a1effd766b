#include <algorithm>
#include <array>

#include "raster.hpp"
#include "samples.hpp"

namespace raster {

namespace {

// As many floats as the widest register holds.
constexpr int wide = 16;

// A range of cells, the end excluded.
struct Range {
  int begin;
  int end;

  int size() const { return end - begin; }
};

// Cells whose samples may be between low and high, of `count`.
Range cells_between(double low, double high, int count) {
  if (!(high >= 0.0 && low < count)) return {0, 0};
  const int first = static_cast<int>(std::max(low, 0.0));
  const int last = static_cast<int>(std::min(high, count - 1.0));
  return {first, last + 1};
}

// A plane about the first cell of a triangle, where single precision is fine enough.
struct LocalPlane {
  float along;
  float down;
  float origin;
};

LocalPlane about(const Plane& plane, int left, int top) {
  return {static_cast<float>(plane.along), static_cast<float>(plane.down),
          static_cast<float>(plane(left, top))};
}

// A triangle, ready to be drawn on a rectangle of cells.
struct Drawing {
  LocalPlane a;  // barycentric coordinates
  LocalPlane b;
  LocalPlane c;
  LocalPlane nearness;  // 1 / depth
  std::int32_t number;  // of the triangle
  Range columns;
  Range rows;
};

// Samples so far. `stride` is the width and some unused cells, so that whole registers can be
// written.
struct Buffer {
  std::vector<float> nearness;  // of the nearest triangle so far
  std::vector<std::int32_t> triangle;
  std::vector<float> column_shift;
  std::vector<float> row_shift;
  std::size_t stride;

  Buffer(const Samples& samples, int columns, int rows)
      : column_shift(columns + wide), row_shift(rows), stride(columns + wide) {
    nearness.assign(stride * rows, 0.0f);
    triangle.assign(stride * rows, -1);
    for (std::size_t i = 0; i < stride; ++i) {
      column_shift[i] = static_cast<float>(samples.shift(static_cast<int>(i)));
    }
    for (int j = 0; j < rows; ++j) {
      row_shift[j] = static_cast<float>(samples.shift(j));
    }
  }
};

// Draw a triangle. A cell outside of it fails one of its three tests, so it does no harm to draw
// some cells more than asked for.
RASTER_KERNEL void draw(const Drawing& drawing, Buffer& buffer) {
  // Copies, which no write to the buffer can change: only then the loops become vectors.
  const auto [a, b, c, near, number, columns, rows] = drawing;
  for (int first = 0; first < columns.size(); first += wide) {
    const float* const shift = buffer.column_shift.data() + columns.begin + first;
    float a_column[wide];
    float b_column[wide];
    float c_column[wide];
    float near_column[wide];
    // The part of each plane that depends on the column alone.
    for (int k = 0; k < wide; ++k) {
      const float across = static_cast<float>(first + k);
      a_column[k] = a.along * across + a.down * shift[k];
      b_column[k] = b.along * across + b.down * shift[k];
      c_column[k] = c.along * across + c.down * shift[k];
      near_column[k] = near.along * across + near.down * shift[k];
    }
    for (int row = 0; row < rows.size(); ++row) {
      const float x = buffer.row_shift[rows.begin + row];
      const float y = static_cast<float>(row);
      const float a_row = a.along * x + a.down * y + a.origin;
      const float b_row = b.along * x + b.down * y + b.origin;
      const float c_row = c.along * x + c.down * y + c.origin;
      const float near_row = near.along * x + near.down * y + near.origin;
      const std::size_t cell = (rows.begin + row) * buffer.stride + columns.begin + first;
      float* const __restrict nearness = buffer.nearness.data() + cell;
      std::int32_t* const __restrict triangle = buffer.triangle.data() + cell;
      // Choices in place of branches: the compiler makes vectors of them.
      for (int k = 0; k < wide; ++k) {
        const float depth = near_column[k] + near_row;
        const bool hit = (a_column[k] + a_row >= 0.0f) & (b_column[k] + b_row >= 0.0f) &
                         (c_column[k] + c_row >= 0.0f) & (depth > nearness[k]);
        nearness[k] = hit ? depth : nearness[k];
        triangle[k] = hit ? number : triangle[k];
      }
    }
  }
}

}  // namespace

std::vector<std::int32_t> visible(Mesh mesh, Window window, int grid) {
  const int width = window.width * grid;
  const int height = window.height * grid;
  const Samples samples(window, grid);
  Buffer buffer(samples, width, height);
  for (std::size_t number = 0; number < mesh.triangles.size(); ++number) {
    const Corners corners = project(samples, mesh.vertices, mesh.triangles[number]);
    const auto [left, right] = std::ranges::minmax(corners.x);
    const auto [top, bottom] = std::ranges::minmax(corners.y);
    const Range columns = cells_between(left, right, width);
    const Range rows = cells_between(top, bottom, height);
    if (columns.size() == 0 || rows.size() == 0) continue;

    const std::array<Plane, 3> inside = corners.barycentric();
    const auto& q = corners.nearness;
    const Plane nearness = interpolate(inside, q[0], q[1], q[2]);
    const int x = columns.begin;
    const int y = rows.begin;
    draw({.a = about(inside[0], x, y),
          .b = about(inside[1], x, y),
          .c = about(inside[2], x, y),
          .nearness = about(nearness, x, y),
          .number = static_cast<std::int32_t>(number),
          .columns = columns,
          .rows = rows},
         buffer);
  }
  // Leave out the unused cells of each row.
  std::vector<std::int32_t> numbers(static_cast<std::size_t>(width) * height);
  for (std::size_t row = 0; row < static_cast<std::size_t>(height); ++row) {
    std::copy_n(buffer.triangle.begin() + row * buffer.stride, width,
                numbers.begin() + row * width);
  }
  return numbers;
}

}  // namespace raster
