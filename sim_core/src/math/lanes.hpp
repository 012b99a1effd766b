// Lanes<W>: W doubles that go through the same arithmetic side by side, one rod per lane.
//
// Every operation acts on each lane alone and is rounded as IEEE 754 asks, so a lane's bits depend neither on its
// neighbours, nor on W, nor on the instruction set (no fused multiply-add: see -ffp-contract in CMakeLists.txt).
//
// All names sit in an unnamed namespace on purpose: the kernels include this file once per instruction set, and the
// linker must never merge a function compiled for AVX-512 with one compiled for the baseline.
#pragma once

namespace sim_core {
namespace {

// The compiler's own vectors. Written out for each W: GCC does not take a template's parameter as a vector's size in
// the parameter of a constructor.
template <int W>
struct VectorOf;

#define SIM_CORE_VECTOR_OF(W)                                                 \
  template <>                                                                 \
  struct VectorOf<W> {                                                        \
    typedef double Values __attribute__((vector_size(W * sizeof(double))));   \
    typedef long long Flags __attribute__((vector_size(W * sizeof(double)))); \
  };
SIM_CORE_VECTOR_OF(1)
SIM_CORE_VECTOR_OF(2)
SIM_CORE_VECTOR_OF(4)
SIM_CORE_VECTOR_OF(8)
#undef SIM_CORE_VECTOR_OF

template <int W>
struct Lanes {
  using Values = typename VectorOf<W>::Values;

  Values v;

  Lanes() = default;
  Lanes(double x) : v(x - Values{}) {}  // x - 0 keeps the sign of a zero
  Lanes(Values values) : v(values) {}

  friend Lanes operator+(Lanes a, Lanes b) { return a.v + b.v; }
  friend Lanes operator-(Lanes a, Lanes b) { return a.v - b.v; }
  friend Lanes operator*(Lanes a, Lanes b) { return a.v * b.v; }
  friend Lanes operator/(Lanes a, Lanes b) { return a.v / b.v; }
  friend Lanes operator-(Lanes a) { return -a.v; }
};

// One truth value per lane: all bits set, or none.
template <int W>
struct Mask {
  typename VectorOf<W>::Flags v;

  Mask() = default;
  explicit Mask(bool x) : v((x ? -1LL : 0LL) - typename VectorOf<W>::Flags{}) {}
  Mask(typename VectorOf<W>::Flags flags) : v(flags) {}

  friend Mask operator&(Mask a, Mask b) { return a.v & b.v; }
  friend Mask operator|(Mask a, Mask b) { return a.v | b.v; }
  friend Mask operator!(Mask a) { return ~a.v; }
};

template <int W>
Mask<W> less(Lanes<W> a, Lanes<W> b) {
  return Mask<W>(a.v < b.v);
}

template <int W>
Mask<W> less_equal(Lanes<W> a, Lanes<W> b) {
  return Mask<W>(a.v <= b.v);
}

// Where the mask is set a, elsewhere b.
template <int W>
Lanes<W> select(Mask<W> mask, Lanes<W> a, Lanes<W> b) {
  return mask.v ? a.v : b.v;
}

template <int W>
Lanes<W> max(Lanes<W> a, Lanes<W> b) {
  return select(less(a, b), b, a);
}

template <int W>
Lanes<W> sqrt(Lanes<W> a) {
  Lanes<W> root;
  for (int lane = 0; lane < W; ++lane) root.v[lane] = __builtin_sqrt(a.v[lane]);
  return root;
}

template <int W>
bool any(Mask<W> mask) {
  long long bits = 0;
  for (int lane = 0; lane < W; ++lane) bits |= mask.v[lane];
  return bits != 0;
}

}  // namespace
}  // namespace sim_core
