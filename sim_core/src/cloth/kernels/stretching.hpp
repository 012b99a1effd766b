// The law of stretching: an energy whose stress under uniaxial strain is that of the table of [Wang
// et al. 2011].
//
// With a = (G00 + G11)/2, h = (G00 - G11)/2, q = G01, z = h^2 + q^2 and r = sqrt(z), the principal
// strains are a + r and a - r. Per area
//
//   W = Q(K0)/2 + m(e) g(t) Q(K(y)),   Q(K) = A a^2 + 2 B a h + C h^2 + D q^2,
//   A = k0 + 2 k1 + k2,   B = k0 - k2,   C = k0 - 2 k1 + k2,   D = 2 k3,
//
// where K0 is the table's row at no strain and K(y) the quartic in y = cos(2 angle) through the
// other rows less K0.
//
//   e = a + z w,   y = h w,   w = 1/r   where r >= a,   else (15 - 10 s + 3 s^2) / (8 a) with s =
//   z/a^2:
//
// e is the larger principal strain and y = h/r; where both strains are positive e tends to a and y
// to 0 as these become equal, for then no direction is the first one. The table's share s(e) =
// (sqrt(1 + 2 e) - 1) / table_stretch, 1 at most, grows with the strain, so (m e^2)' = s(e) e gives
//
//   m = 2 e - 3 e^2/4 + d e^3/5 up to the strain U of the table's end,   1/2 + c/e^2 beyond.
//
// g = t^2 (6 - 8 t + 3 t^2) with t = (a + r)/r, at most 1, takes the table away where nothing is in
// tension. W is twice continuously differentiable except at e = U and at no strain.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

constexpr double table_end = 0.5 * ((1.0 + table_stretch) * (1.0 + table_stretch) - 1.0);  // U
constexpr double share_cubic = (1.0 - 6.0 * table_end + 3.0 * table_end * table_end) /
                               (table_end * table_end * table_end);  // d
constexpr double share_tail =
    (table_end * (2.0 - table_end * (0.75 - 0.2 * share_cubic * table_end)) - 0.5) * table_end *
    table_end;  // c

// An energy per area with its derivatives by (a, h, q).
struct StretchLaw {
  Lane energy, a, h, q;
  Lane aa, ah, aq, hh, hq, qq;
};

// Q and its derivatives by (a, h, q) at K fixed.
struct Quadratic {
  Lane value, a, h, q;
};

inline Quadratic quadratic(const Lane (&k)[4], Lane a, Lane h, Lane q) {
  const Lane by_a = k[0] * a + k[1] * h, by_h = k[1] * a + k[2] * h, by_q = k[3] * q;
  return {a * by_a + h * by_h + q * by_q, 2.0 * by_a, 2.0 * by_h, 2.0 * by_q};
}

// Adds m g Q(K(y)). `k`: the five coefficients in y of each of A, B, C, D.
template <bool matrix>
inline void add_table(StretchLaw& law, const double* k, Lane a, Lane h, Lane q) {
  const Lane zero{}, one = zero + 1.0;
  const Lane z = h * h + q * q + 1e-60;
  const Lane equal = a * a - z;  // > 0: of one sign
  const auto both = (a > zero) & (equal > zero);
  // w and its derivatives by a and z.
  const Lane inverse = one / (both ? a : root(z)), inverse2 = inverse * inverse,
             inverse3 = inverse * inverse2;
  const Lane s = both ? z * inverse2 : zero;
  const Lane w = both ? 0.125 * inverse * (15.0 - s * (10.0 - 3.0 * s)) : inverse;
  const Lane w_a = both ? -1.875 * inverse2 * (one - s) * (one - s) : zero;
  const Lane w_z = inverse3 * (both ? 0.75 * s - 1.25 : -0.5 * one);
  const Lane e = a + z * w, e_a = 1.0 + z * w_a, e_z = w + z * w_z;
  // m.
  const Lane tension = e > zero ? e : zero;
  const auto inside = tension <= table_end;
  const Lane tail = one / (inside ? one : tension * tension);
  const Lane m = inside ? tension * (2.0 - tension * (0.75 - 0.2 * share_cubic * tension))
                        : 0.5 + share_tail * tail;
  const Lane m_e = inside ? 2.0 - tension * (1.5 - 0.6 * share_cubic * tension)
                          : -2.0 * share_tail * tail / tension;
  // g, whose derivatives are zero where t is 0 or 1, or m is zero.
  const Lane ratio = a < zero ? 1.0 + a * w : one, t = ratio > zero ? ratio : zero, rest = one - t;
  const Lane t_z = a * w_z, g = t * t * (6.0 - t * (8.0 - 3.0 * t)), g_t = 12.0 * t * rest * rest;
  // u = m g.
  const Lane u = m * g, u_e = m_e * g, u_t = m * g_t;
  const Lane u_a = u_e * e_a + u_t * w, u_z = u_e * e_z + u_t * t_z;
  // Q.
  const Lane y = h * w;
  Lane value[4], slope[4], bend[4];
  for (int c = 0; c < 4; ++c) {
    const double* p = k + 5 * c;
    value[c] = p[0] + y * (p[1] + y * (p[2] + y * (p[3] + y * p[4])));
    slope[c] = p[1] + y * (2.0 * p[2] + y * (3.0 * p[3] + y * (4.0 * p[4])));
    if (matrix) bend[c] = 2.0 * p[2] + y * (6.0 * p[3] + y * (12.0 * p[4]));
  }
  const Quadratic base = quadratic(value, a, h, q), turn = quadratic(slope, a, h, q);
  const Lane h2 = 2.0 * h, q2 = 2.0 * q;  // of z by h and q
  const Lane y_a = h * w_a, y_z = h * w_z, y_h = w + y_z * h2, y_q = y_z * q2;
  const Lane Q = base.value;
  const Lane Q_a = base.a + turn.value * y_a, Q_h = base.h + turn.value * y_h,
             Q_q = base.q + turn.value * y_q;
  const Lane u_h = u_z * h2, u_q = u_z * q2;
  law.energy += u * Q;
  law.a += u_a * Q + u * Q_a;
  law.h += u_h * Q + u * Q_h;
  law.q += u_q * Q + u * Q_q;
  if constexpr (matrix) {
    const Lane inverse4 = inverse2 * inverse2, inverse5 = inverse2 * inverse3;
    const Lane w_aa = both ? inverse3 * (3.75 - s * (15.0 - 11.25 * s)) : zero;
    const Lane w_az = both ? 3.75 * inverse4 * (one - s) : zero;
    const Lane w_zz = 0.75 * inverse5;
    const Lane e_aa = z * w_aa, e_az = w_a + z * w_az, e_zz = 2.0 * w_z + z * w_zz;
    const Lane m_ee = inside ? -1.5 + 1.2 * share_cubic * tension : 6.0 * share_tail * tail * tail;
    const Lane u_ee = m_ee * g, u_et = m_e * g_t, u_tt = 12.0 * m * rest * (one - 3.0 * t);
    const Lane u_aa = u_ee * e_a * e_a + u_e * e_aa + 2.0 * u_et * e_a * w + u_tt * w * w;
    const Lane u_az =
        u_ee * e_a * e_z + u_e * e_az + u_et * (e_a * t_z + e_z * w) + u_tt * w * t_z + u_t * w_z;
    const Lane u_zz =
        u_ee * e_z * e_z + u_e * e_zz + 2.0 * u_et * e_z * t_z + u_tt * t_z * t_z + u_t * a * w_zz;
    const Lane u_ah = u_az * h2, u_aq = u_az * q2;
    const Lane u_hh = u_zz * h2 * h2 + 2.0 * u_z, u_hq = u_zz * h2 * q2,
               u_qq = u_zz * q2 * q2 + 2.0 * u_z;
    const Lane y_zz = h * w_zz, y_az = h * w_az;
    const Lane y_aa = h * w_aa, y_ah = w_a + y_az * h2, y_aq = y_az * q2;
    const Lane y_hh = 2.0 * w_z * h2 + y_zz * h2 * h2 + 2.0 * y_z, y_hq = w_z * q2 + y_zz * h2 * q2;
    const Lane y_qq = y_zz * q2 * q2 + 2.0 * y_z;
    const Lane Q1 = turn.value, Q2 = quadratic(bend, a, h, q).value;
    const Lane Q_aa = 2.0 * value[0] + 2.0 * turn.a * y_a + Q2 * y_a * y_a + Q1 * y_aa;
    const Lane Q_ah = 2.0 * value[1] + turn.a * y_h + turn.h * y_a + Q2 * y_a * y_h + Q1 * y_ah;
    const Lane Q_aq = turn.a * y_q + turn.q * y_a + Q2 * y_a * y_q + Q1 * y_aq;
    const Lane Q_hh = 2.0 * value[2] + 2.0 * turn.h * y_h + Q2 * y_h * y_h + Q1 * y_hh;
    const Lane Q_hq = turn.h * y_q + turn.q * y_h + Q2 * y_h * y_q + Q1 * y_hq;
    const Lane Q_qq = 2.0 * value[3] + 2.0 * turn.q * y_q + Q2 * y_q * y_q + Q1 * y_qq;
    law.aa += u_aa * Q + 2.0 * u_a * Q_a + u * Q_aa;
    law.ah += u_ah * Q + u_a * Q_h + u_h * Q_a + u * Q_ah;
    law.aq += u_aq * Q + u_a * Q_q + u_q * Q_a + u * Q_aq;
    law.hh += u_hh * Q + 2.0 * u_h * Q_h + u * Q_hh;
    law.hq += u_hq * Q + u_h * Q_q + u_q * Q_h + u * Q_hq;
    law.qq += u_qq * Q + 2.0 * u_q * Q_q + u * Q_qq;
  }
}

// `k`: A, B, C, D at no strain, then, where `tabulated`, what `add_table` takes.
template <bool matrix>
inline StretchLaw stretch_law(const double* k, bool tabulated, Lane a, Lane h, Lane q) {
  const Lane zero{}, none[4] = {zero + k[0], zero + k[1], zero + k[2], zero + k[3]};
  const Quadratic stretch = quadratic(none, a, h, q);
  StretchLaw law{0.5 * stretch.value,
                 0.5 * stretch.a,
                 0.5 * stretch.h,
                 0.5 * stretch.q,
                 none[0],
                 none[1],
                 zero,
                 none[2],
                 zero,
                 none[3]};
  if (tabulated) add_table<matrix>(law, k + 4, a, h, q);
  return law;
}

inline bool is_definite(const StretchLaw& law) {
  const Lane zero{};
  const Lane minor = law.aa * law.hh - law.ah * law.ah;
  const Lane whole = law.qq * minor - law.aa * law.hq * law.hq - law.hh * law.aq * law.aq +
                     2.0 * law.ah * law.aq * law.hq;
  const auto definite = (law.aa > zero) & (minor > zero) & (whole >= zero);
  bool all = true;
  for (int l = 0; l < membrane_lanes; ++l) all = all && definite[l];
  return all;
}

// A rotation of Jacobi that takes m_pk to zero. The columns of v become the eigenvectors.
inline void rotate(Lane (&m)[3][3], Lane (&v)[3][3], int p, int k) {
  const Lane zero{}, one = zero + 1.0;
  // t^2 + 2 theta t = 1 with the smaller |t|.
  const Lane off = 2.0 * m[p][k], gap = m[k][k] - m[p][p];
  const Lane size = (gap < zero ? -gap : gap) + root(gap * gap + off * off) + 1e-300;
  const Lane t = (gap < zero ? -off : off) / size, c = one / root(one + t * t), s = t * c;
  for (int i = 0; i < 3; ++i) {
    const Lane x = m[i][p], y = m[i][k];
    m[i][p] = c * x - s * y, m[i][k] = s * x + c * y;
  }
  for (int i = 0; i < 3; ++i) {
    const Lane x = m[p][i], y = m[k][i];
    m[p][i] = c * x - s * y, m[k][i] = s * x + c * y;
  }
  for (int i = 0; i < 3; ++i) {
    const Lane x = v[i][p], y = v[i][k];
    v[i][p] = c * x - s * y, v[i][k] = s * x + c * y;
  }
}

// Makes the law's second derivatives positive semi-definite where they are not: negative
// eigenvalues become zero [Teran et al. 2005]. (a, h, q) have the metric of strain, so this does
// not depend on the axes.
inline void make_definite(StretchLaw& law) {
  constexpr int sweeps = 4;  // of Jacobi's rotations, to rounding
  if (is_definite(law)) return;
  const Lane zero{}, one = zero + 1.0;
  Lane m[3][3] = {{law.aa, law.ah, law.aq}, {law.ah, law.hh, law.hq}, {law.aq, law.hq, law.qq}};
  Lane v[3][3] = {{one, zero, zero}, {zero, one, zero}, {zero, zero, one}};
  for (int sweep = 0; sweep < sweeps; ++sweep) {
    rotate(m, v, 0, 1);
    rotate(m, v, 0, 2);
    rotate(m, v, 1, 2);
  }
  // K - sum of the negative part.
  Lane* const entries[6] = {&law.aa, &law.ah, &law.aq, &law.hh, &law.hq, &law.qq};
  constexpr int rows[6] = {0, 0, 0, 1, 1, 2}, columns[6] = {0, 1, 2, 1, 2, 2};
  for (int k = 0; k < 3; ++k) {
    const Lane negative = m[k][k] < zero ? m[k][k] : zero;
    for (int i = 0; i < 6; ++i) *entries[i] -= negative * v[rows[i]][k] * v[columns[i]][k];
  }
}

}  // namespace
}  // namespace sim_core
