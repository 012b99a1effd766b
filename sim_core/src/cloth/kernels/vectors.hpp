// The registers of the cloth kernels: CLOTH_FLOATS floats, a node (x, y, z, 0), and eight triangles side by side.
#pragma once

#include "cloth/problem.hpp"

namespace sim_core {
namespace {

typedef float Floats __attribute__((vector_size(4 * CLOTH_FLOATS), aligned(4), may_alias));
typedef int Integers __attribute__((vector_size(4 * CLOTH_FLOATS), aligned(4), may_alias));
typedef float Node __attribute__((vector_size(16), aligned(16), may_alias));
typedef double NodeD __attribute__((vector_size(32), aligned(32), may_alias));
typedef double Lane __attribute__((vector_size(8 * membrane_lanes), aligned(64), may_alias));

// Takes denormal numbers for zeros while it lives. A factor has many of them where many nodes stick, and processors are
// slow with them.
struct FlushTiny {
#if defined(__SSE__)
  unsigned before = __builtin_ia32_stmxcsr();
  FlushTiny() { __builtin_ia32_ldmxcsr(before | 0x8040u); }
  ~FlushTiny() { __builtin_ia32_ldmxcsr(before); }
#endif
};

inline Integers lane_numbers() {
  Integers lanes;
  for (int l = 0; l < CLOTH_FLOATS; ++l) lanes[l] = l;
  return lanes;
}

inline Node spread(float s) { return Node{s, s, s, s}; }
inline NodeD spread(double s) { return NodeD{s, s, s, s}; }
inline float dot3(Node a, Node b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double dot3(NodeD a, NodeD b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline Lane root(Lane a) {
  Lane r;
  for (int l = 0; l < membrane_lanes; ++l) r[l] = __builtin_sqrt(a[l]);
  return r;
}

}  // namespace
}  // namespace sim_core
