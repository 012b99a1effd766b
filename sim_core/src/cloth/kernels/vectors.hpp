// The registers of the cloth kernels: CLOTH_FLOATS floats, a node (x, y, z, 0), and eight triangles
// side by side.
#pragma once

#if CLOTH_FLOATS > 4
#include <immintrin.h>
#endif

#include "cloth/problem.hpp"

namespace sim_core {
namespace {

typedef float Floats __attribute__((vector_size(4 * CLOTH_FLOATS), aligned(4), may_alias));
typedef int Integers __attribute__((vector_size(4 * CLOTH_FLOATS), aligned(4), may_alias));
typedef float Node __attribute__((vector_size(16), aligned(16), may_alias));
typedef double NodeD __attribute__((vector_size(32), aligned(32), may_alias));
typedef double Lane __attribute__((vector_size(8 * membrane_lanes), aligned(64), may_alias));

// Takes denormal numbers for zeros while it lives. A factor has many of them where many nodes
// stick, and processors are slow with them.
struct FlushTiny {
#if defined(__SSE__)
  unsigned before = __builtin_ia32_stmxcsr();
  FlushTiny() { __builtin_ia32_ldmxcsr(before | 0x8040u); }
  ~FlushTiny() { __builtin_ia32_ldmxcsr(before); }
#endif
};

inline Floats wide(const float* from) { return *reinterpret_cast<const Floats*>(from); }
inline void keep(Floats v, float* to) { *reinterpret_cast<Floats*>(to) = v; }

// Numbers of half precision, where vectors are wide; cut, not rounded, so that none becomes
// infinite.
#if CLOTH_FLOATS == 4
typedef float Half;
#else
typedef unsigned short Half;
#if CLOTH_FLOATS == 16
inline Floats wide(const Half* from) {
  return _mm512_cvtph_ps(_mm256_loadu_si256((const __m256i*)from));
}
inline void keep(Floats v, Half* to) {
  _mm256_storeu_si256((__m256i*)to, _mm512_cvtps_ph(v, _MM_FROUND_TO_ZERO));
}
#else
inline Floats wide(const Half* from) {
  return _mm256_cvtph_ps(_mm_loadu_si128((const __m128i*)from));
}
inline void keep(Floats v, Half* to) {
  _mm_storeu_si128((__m128i*)to, _mm256_cvtps_ph(v, _MM_FROUND_TO_ZERO));
}
#endif
#endif

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
