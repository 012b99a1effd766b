// What the cloth kernels work on: plain arrays, owned by ClothSolver. Nothing here may pull in a
// template of the standard library: kernels/kernel.cpp is compiled once per instruction set, and
// the linker must never merge their instances.
//
// Nodes are numbered in the order of elimination: free nodes first, held ones after. Vectors over
// nodes have four components a node, the fourth is zero, so that a node is one vector register.
#pragma once

#include "contact/rows.hpp"

namespace sim_core {

// Triangles go through the membrane in groups of this many.
constexpr int membrane_lanes = 8;

// Rows and pivots of a front are padded to this many floats.
constexpr int front_padding = 16;

// A factor is kept in tiles of so many rows, and of at most so many columns: three of each node.
constexpr int tile_rows = 16, tile_columns = 12;
constexpr long half_from =
    4'000'000;  // floats, 16 MB, from which half precision is used: solves then wait for memory

// Floats of a block of `width` columns with `below` rows under its triangle.
constexpr long tile_floats(long width, long below) {
  return width * (tile_rows + (below + tile_rows - 1) / tile_rows * tile_rows);
}

// Krylov vectors that one linear solve may use.
constexpr int krylov_max = 40;

// Vectors that go through the matrix and the factor at once: their sums fill the registers.
constexpr int solve_group = 4;

// Directions that linear problems of one matrix share.
constexpr int directions_max = 96;

// The table of [Wang et al. 2011] ends at this stretch less one.
constexpr double table_stretch = 1.0 / 6.0;

struct MembraneData {
  int groups;        // of triangles of one fabric each
  const int* nodes;  // (groups, 3, lanes)
  const double*
      shape;           // (groups, 4, lanes): gradients of the shape functions of nodes 1 and 2, 1/m
  const double* area;  // (groups, lanes), 0 in the lanes that pad the last group
  const int* fabric;   // (groups)
  const double* law;  // (fabrics, 24): A, B, C, D at no strain, then five coefficients of each, N/m
  const char* tabulated;  // (fabrics): whether these five are not all zero
  const int* slots;   // (groups, lanes, 9): blocks 01 10 02 20 12 21 00 11 22 of the matrix, -1 for
                      // held nodes
  const double* lag;  // (groups, 9, lanes): strain at the start of a step, and what holds it there;
                      // null: nothing
};

// How the rigidity of a fabric falls with curvature; see kernels/bending.hpp.
struct SofteningData {
  double curvature = 0.0;  // k_s, 1/m; 0: it does not fall
  double rigidity = 0.0;   // D, N m: the geometric mean of warp and weft
};

// Of each triangle the second derivatives (H11, H22, 2 H12) are linear in the positions of the
// nodes of its stencil.
struct BendingData {
  int triangles;
  const int* begin;                // (triangles + 1)
  const int* nodes;                // by stencil entry
  const double* weights;           // (entries, 4): of H11, H22, 2 H12, and 0; 1/m^2
  const double* area;              // (triangles), m^2
  const double* spacing2;          // (triangles), m^2: square of the length over which a fold turns
  const int* fabric;               // (triangles)
  const double* rigidity;          // (fabrics, 6): 11 12 16 22 26 66, N m
  const SofteningData* softening;  // (fabrics)
  const int* slot_begin;  // (triangles): first slot of the lower pairs (i, j <= i) of the stencil,
                          // in order
  const int* slots;       // scalar slots of (i, j) and (j, i), -1 for held nodes
};

// The part of bending's matrix that sharp folds add: of each, with vectors a and b over the free
// nodes of its stencil, aa a a^T + ab (a b^T + b a^T) + bb b b^T.
struct FoldData {
  int free_nodes;
  double smallest;  // s from which a triangle is a fold
  int count;
  int* begin;           // (triangles + 1)
  int* nodes;           // by entry
  float* vectors;       // (entries, 2, 4): a and b, 1/m^2 times m and N m
  float* coefficients;  // (triangles, 3): aa, ab, bb
};

// K = mass + bending (x) 1 + membrane + folds + pairs, over the free nodes.
struct ClothMatrix {
  int nodes;
  const int* bending_begin;  // (nodes + 1)
  const int* bending_node;
  float* bending;
  const int* membrane_begin;  // (nodes + 1)
  const int* membrane_node;
  float* membrane;  // (blocks, 3, 4): columns
  float* diagonal;  // (nodes): inertia and damping, N/m
  const FoldData* folds;
  const PairData* pairs;  // may be null
};

// `count` rows of a front from `row` on are those of its parent from `place` on, in nodes, the
// parent's pivots first.
struct FrontRun {
  int row, count, place;
};

// A Cholesky factor by fronts (multifrontal). Front f eliminates nodes pivot_begin[f] ...
// pivot_begin[f + 1]; its other rows are rows[row_begin[f]] ... . Children come before parents, in
// postorder.
//
// A front's columns go into blocks of `tile_columns`. Of each block come the inverse of its
// triangle, as one tile, and then the rows below, tile after tile, so that a solve reads memory
// from one end to the other.
struct Factor {
  int fronts;
  const char* due;  // (fronts): whether it must be refactored; where a child is due, the parent is
  const int* pivot_begin;  // (fronts + 1)
  const int* row_begin;    // (fronts + 1)
  const int* rows;         // nodes
  const int* child_begin;  // (fronts + 1)
  const int* children;     // fronts
  const int*
      run_begin;  // (fronts + 1): rows of a front that follow each other in its parent's, too
  const FrontRun* runs;
  const long* update_begin;  // (fronts): where the part of a front that waits for its parent lies
                             // in `updates`
  const long* tile_begin;    // (fronts + 1): offset of the first tile, floats
  const long* entry_begin;   // (fronts + 1): entries of K that go into the front
  const int* entry_slot;     // of a bending scalar
  const int* entry_block;    // of a membrane block or -1
  const int* entry_row;      // place in the front, nodes
  const int* entry_column;
  bool half;  // whether tiles are of half precision, see kernels/vectors.hpp, or of floats
  void* tiles;
  float* panel;  // the front that is being made
  float* updates;
  float* local;       // one front's right-hand sides, `solve_group` of them
  long local_floats;  // of each
  const int* order;   // nodes by their place in a factor of its own order, or null
  float* ordered;     // `solve_group` vectors in that order
};

// Directions in which linear problems of one matrix J were solved, for those that follow.
struct DirectionSpace {
  int count;          // at most `directions_max`, of which the arrays have room
  float* directions;  // (directions, nodes, 4): z_k
  float* images;      // (directions, nodes, 4): w_k, with w_j . M^-1 w_k = 1 where j = k, else 0
  float* preconditioned;  // (directions, nodes, 4): M^-1 w_k
  double* triangle;       // (directions k, directions j): J z_k = sum_j triangle_kj images_j
};

struct ClothKernel {
  const char* name;
  // Adds gradients and returns the energy. `blocks` and `folds` may be null.
  double (*membrane)(const MembraneData&, const double* x, double* gradient, float* blocks,
                     bool definite);
  void (*membrane_lag)(const MembraneData&, const double* x, double fraction, double* lag);
  double (*bending)(const BendingData&, const double* x, double* gradient, float* stiffening,
                    FoldData* folds);
  // Adds how the gradient changes along `count` vectors, at most `solve_group`.
  void (*bending_changes)(const BendingData&, const double* x, int count,
                          const double* const* along, double* const* changes);
  void (*bending_matrix)(const BendingData&, const float* stiffening, float* scalars);
  void (*apply)(const ClothMatrix&, const float* x, float* y);
  // `added`: (nodes, 6), xx xy xz yy yz zz, N/m. A node keeps its own stiffness, and in contact
  // some more: the factor need not be exact.
  void (*factor)(const Factor&, const ClothMatrix&, const float* added);
  // Returns the iterations.
  int (*krylov)(const ClothMatrix&, const Factor&, const ContactRows&, const float* b, float* x,
                float* work, double tolerance);
  // Solves J x = b for `count` right-hand sides, at most `solve_group`, each until the largest
  // component of M^-1 r is at most its target, or `tolerance` of that at first, `expected`, or the
  // space is full. M is the factor's matrix, and r the residual of b. Returns the triangular
  // solves.
  int (*recycle)(const ClothMatrix&, const Factor&, const ContactRows&, DirectionSpace&, int count,
                 float* b, float* x, double tolerance, const double* targets, double* expected);
};

// One for each instruction set that they are compiled for; kernels/kernel.cpp is the code of all of
// them.
extern const ClothKernel cloth_baseline, cloth_x86_64_v3, cloth_x86_64_v4;

}  // namespace sim_core
