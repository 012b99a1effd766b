// Lanes<W>: W doubles that go through the same arithmetic side by side, one rod per lane.
//
// Every operation acts on each lane alone and is rounded as IEEE 754 asks, so a lane's bits depend
// neither on its neighbours, nor on W, nor on the instruction set (no fused multiply-add: see
// -ffp-contract in CMakeLists.txt).
//
// All names sit in an unnamed namespace on purpose: the kernels include this file once per
// instruction set, and the linker must never merge a function compiled for AVX-512 with one
// compiled for the baseline.
#pragma once

namespace sim_core {
namespace {

// The compiler's own vectors. Written out for each W: GCC does not take a template's parameter as a
// vector's size in the parameter of a constructor.
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

// Rotations: vectors, symmetric 3x3 matrices and unit quaternions over lanes T, and the SO(3)
// exponential and logarithm.
//
// Eigen's types are not used here: its inline functions would be compiled once per instruction set
// and merged by the linker (see above). Unit quaternions turn vectors of the material frame into
// world vectors.

template <class T>
struct Vec3 {
  T x, y, z;

  friend Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
  friend Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
  friend Vec3 operator*(T s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
};

template <class T>
T dot(Vec3<T> a, Vec3<T> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class T>
Vec3<T> cross(Vec3<T> a, Vec3<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// A symmetric 3x3 matrix.
template <class T>
struct Sym3 {
  T xx, xy, xz, yy, yz, zz;

  friend Sym3 operator+(Sym3 a, Sym3 b) {
    return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz};
  }
  friend Sym3 operator-(Sym3 a, Sym3 b) {
    return {a.xx - b.xx, a.xy - b.xy, a.xz - b.xz, a.yy - b.yy, a.yz - b.yz, a.zz - b.zz};
  }
  friend Vec3<T> operator*(Sym3 a, Vec3<T> v) {
    return {a.xx * v.x + a.xy * v.y + a.xz * v.z, a.xy * v.x + a.yy * v.y + a.yz * v.z,
            a.xz * v.x + a.yz * v.y + a.zz * v.z};
  }
};

// s I + (a b^T + b a^T) / 2
template <class T>
Sym3<T> scaled_identity_plus_symmetric_product(T s, Vec3<T> a, Vec3<T> b) {
  const Vec3<T> h = T(0.5) * b;
  return {s + a.x * b.x, a.x * h.y + a.y * h.x, a.x * h.z + a.z * h.x,
          s + a.y * b.y, a.y * h.z + a.z * h.y, s + a.z * b.z};
}

// A 3x3 matrix by its columns.
template <class T>
struct Mat3 {
  Vec3<T> x, y, z;

  friend Vec3<T> operator*(Mat3 m, Vec3<T> v) { return v.x * m.x + v.y * m.y + v.z * m.z; }
};

// w + i x + j y + k z, with v = (x, y, z).
template <class T>
struct Quat {
  T w;
  Vec3<T> v;

  friend Quat operator+(Quat a, Quat b) { return {a.w + b.w, a.v + b.v}; }
  friend Quat operator-(Quat a, Quat b) { return {a.w - b.w, a.v - b.v}; }
  friend Quat operator*(T s, Quat a) { return {s * a.w, s * a.v}; }
  friend Quat operator*(Quat a, Quat b) {
    return {a.w * b.w - dot(a.v, b.v), a.w * b.v + b.w * a.v + cross(a.v, b.v)};
  }
};

template <class M, class T>
Vec3<T> select(M mask, Vec3<T> a, Vec3<T> b) {
  return {select(mask, a.x, b.x), select(mask, a.y, b.y), select(mask, a.z, b.z)};
}

template <class M, class T>
Quat<T> select(M mask, Quat<T> a, Quat<T> b) {
  return {select(mask, a.w, b.w), select(mask, a.v, b.v)};
}

template <class T>
Quat<T> conjugate(Quat<T> q) {
  return {q.w, T(-1.0) * q.v};
}

template <class T>
Quat<T> normalized(Quat<T> q) {
  return (T(1.0) / sqrt(q.w * q.w + dot(q.v, q.v))) * q;
}

// One Newton step for 1/|q|: exact to rounding for a quaternion that is unit up to rounding.
template <class T>
Quat<T> renormalized(Quat<T> q) {
  return (T(1.5) - T(0.5) * (q.w * q.w + dot(q.v, q.v))) * q;
}

// First, second and third material directions of the frame q, in the world.
template <class T>
Vec3<T> direction1(Quat<T> q) {
  const Vec3<T> v = q.v;
  return {T(1.0) - T(2.0) * (v.y * v.y + v.z * v.z), T(2.0) * (v.x * v.y + q.w * v.z),
          T(2.0) * (v.x * v.z - q.w * v.y)};
}

template <class T>
Vec3<T> direction2(Quat<T> q) {
  const Vec3<T> v = q.v;
  return {T(2.0) * (v.x * v.y - q.w * v.z), T(1.0) - T(2.0) * (v.x * v.x + v.z * v.z),
          T(2.0) * (v.y * v.z + q.w * v.x)};
}

template <class T>
Vec3<T> direction3(Quat<T> q) {
  const Vec3<T> v = q.v;
  return {T(2.0) * (v.x * v.z + q.w * v.y), T(2.0) * (v.y * v.z - q.w * v.x),
          T(1.0) - T(2.0) * (v.x * v.x + v.y * v.y)};
}

// (1 - atan(sqrt z) / sqrt z) / z on [0, 1] to 3e-17: Chebyshev interpolation at 20 nodes, in
// powers of z, evaluated as Estrin's tree because the chain of Horner's rule is three times as
// long.
template <class T>
T arctangent_defect(T z) {
  const T z2 = z * z, z4 = z2 * z2, z8 = z4 * z4, z16 = z8 * z8;
  const auto cubic = [&](double a, double b, double c, double d) {
    return (T(a) + T(b) * z) + (T(c) + T(d) * z) * z2;
  };
  const T p0 = cubic(0x1.5555555555555p-2, -0x1.9999999999620p-3, 0x1.24924924753ecp-3,
                     -0x1.c71c71bb00a6cp-4);
  const T p1 = cubic(0x1.745d15ee35819p-4, -0x1.3b1399d1dcdc7p-4, 0x1.110fff599e4d2p-4,
                     -0x1.e1d0239d392a6p-5);
  const T p2 = cubic(0x1.aebbb1647a168p-5, -0x1.841dcf603a209p-5, 0x1.5d02278205cc7p-5,
                     -0x1.3328700bb8169p-5);
  const T p3 = cubic(0x1.00390504e9f2fp-5, -0x1.843f4bca23369p-6, 0x1.fd0e4de8fed90p-7,
                     -0x1.123baedb61abdp-7);
  const T p4 = cubic(0x1.ca3677db66678p-9, -0x1.1325b2f8964bep-10, 0x1.a359b96a4eee4p-13,
                     -0x1.2f07811f9f6e9p-16);
  return (p0 + p1 * z4) + (p2 + p3 * z4) * z8 + p4 * z16;
}

// The rotation vector theta of a quaternion with w >= 0, with what the derivatives of the logarithm
// need: x = |theta|^2,  c = (1 - (|theta|/2) cot(|theta|/2)) / x,  dc = dc/dx.
template <class T>
struct Logarithm {
  Vec3<T> theta;
  T x, c, dc;
};

// With u = tan(|theta|/4) and z = u^2: |theta| = 4 atan(u) = 4 u P, (|theta|/2) cot(|theta|/2) = (1
// - z) P, so that with P = 1 - z Q no difference of close numbers is left in c = (1 + Q (1 - z)) /
// (16 P^2).
template <class T>
Logarithm<T> logarithm(Quat<T> q) {
  const Vec3<T> u = (T(1.0) / (T(1.0) + q.w)) * q.v;
  const T z = dot(u, u);
  const T Q = arctangent_defect(z);
  const T P = T(1.0) - z * Q;
  const T x = T(16.0) * z * P * P;
  // One division for both 1/P^2 and 1/x; the floor only keeps 0/0 away, where dc does not matter.
  const T z_floored = max(z, T(1e-10));
  const T inverse = T(0.0625) / (P * P * z_floored);
  const T c = (T(1.0) + Q * (T(1.0) - z)) * (inverse * z_floored);
  // y = 1 - x c = (|theta|/2) cot(|theta|/2) and dy/dx = y c / 2 - 1/8 give dc/dx = (1/8 - c - y c
  // / 2) / x.
  const T y = (T(1.0) - z) * P;
  const T dc = (T(0.125) - c - T(0.5) * (y * c)) * inverse;
  return {T(4.0) * P * u, x, c, dc};
}

// exp of a rotation vector of up to about 2.5 rad, by the Taylor series of cos and sin(a)/a at a =
// |theta|/2.
template <class T>
Quat<T> exponential(Vec3<T> theta) {
  const T a2 = T(0.25) * dot(theta, theta);
  T cosine = T(1.0), sinc = T(1.0);
  for (int k = 12; k >= 1; --k) {
    cosine = T(1.0) - a2 * T(1.0 / ((2 * k - 1) * (2 * k))) * cosine;
    sinc = T(1.0) - a2 * T(1.0 / ((2 * k) * (2 * k + 1))) * sinc;
  }
  return {cosine, T(0.5) * sinc * theta};
}

// A unit quaternion that agrees with exp(omega) to second order and needs no series: ((1 - p^2), 2
// p) / (1 + p^2) with p = omega / 4.
template <class T>
Quat<T> retraction(Vec3<T> omega) {
  const Vec3<T> p = T(0.25) * omega;
  const T p2 = dot(p, p);
  const T inverse = T(1.0) / (T(1.0) + p2);
  return {(T(1.0) - p2) * inverse, (T(2.0) * inverse) * p};
}

}  // namespace
}  // namespace sim_core
