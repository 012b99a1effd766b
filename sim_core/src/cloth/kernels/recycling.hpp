// A Krylov method for several right-hand sides that uses its directions again.
#pragma once

#include "cloth/kernels/vector_groups.hpp"

namespace sim_core {
namespace {

// A direction whose image across those before is this small a part of it is taken for one of
// theirs: what rounding adds to it, and to M^-1 of it, would be made as many times larger.
constexpr double dependent = 1e-2;
// Share of a residual that a direction must take from it for the next one to come of it: what
// hardly changed leads nowhere new, and the last image takes its place [Jiranek et al. 2008].
constexpr double stagnant = 0.8;

inline float largest_of(const float* v, long floats) {
  Floats most = {};
  for (long i = 0; i < floats; i += 4) {
    for (int c = 0; c < 4; ++c) {
      const float size = __builtin_fabsf(v[i + c]);
      most[c] = most[c] < size ? size : most[c];
    }
  }
  float out = 0.0f;
  for (int c = 0; c < 4; ++c) out = out < most[c] ? most[c] : out;
  return out;
}

// Divides a vector by its largest component, which it returns: squares of a derivative that
// consists of rounding alone would be too small for single precision. A vector of zeros stays.
inline double scale_to_one(float* v, long floats) {
  const float largest = largest_of(v, floats);
  if (!(largest > 0.0f)) return 1.0;
  for (long i = 0; i < floats; ++i) v[i] /= largest;
  return largest;
}

// Makes the images after the space's `count` first ones orthonormal in the norm of the factor,
// w . M^-1 w, and drops those that depend on others. Returns how many were not dropped.
inline int orthonormalise(DirectionSpace& space, int added, long floats) {
  const int before = space.count;
  double size[solve_group], shares[solve_group][directions_max];
  const auto image = [&](int k) { return space.images + k * floats; };
  const auto lead = [&](int k) { return space.preconditioned + k * floats; };
  for (int a = 0; a < added; ++a) size[a] = product(image(before + a), lead(before + a), floats);
  const auto take_from = [&](int j, int k, int a) {
    shares[a][j] = product(lead(j), image(k), floats);
    add_multiple(image(k), float(-shares[a][j]), image(j), floats);
    add_multiple(lead(k), float(-shares[a][j]), lead(j), floats);
  };
  for (int j = 0; j < before; ++j) {
    for (int a = 0; a < added; ++a) take_from(j, before + a, a);
  }
  for (int a = 0; a < added; ++a) {
    const int from = before + a, k = space.count;
    for (int j = before; j < k; ++j) take_from(j, from, a);
    const double left = product(image(from), lead(from), floats);
    if (!(left > dependent * dependent * size[a])) continue;
    shares[a][k] = __builtin_sqrt(left);
    const float scale = float(1.0 / shares[a][k]);
    float *w = image(k), *q = lead(k);
    const float *w_from = image(from), *q_from = lead(from);
    for (long i = 0; i < floats; ++i) {
      w[i] = scale * w_from[i];
      q[i] = scale * q_from[i];
    }
    if (k != from)
      __builtin_memcpy(space.directions + k * floats, space.directions + from * floats,
                       sizeof(float) * floats);
    __builtin_memcpy(space.triangle + 1L * k * directions_max, shares[a], sizeof(double) * (k + 1));
    ++space.count;
  }
  return space.count - before;
}

// x = unit times the sum of directions whose images have these shares.
inline void combine(const DirectionSpace& space, long floats, double unit, double* shares,
                    float* x) {
  for (long i = 0; i < floats; ++i) x[i] = 0.0f;
  for (int k = space.count - 1; k >= 0; --k) {
    const double* column = space.triangle + 1L * k * directions_max;
    const double factor = shares[k] / column[k];
    for (int j = 0; j < k; ++j) shares[j] -= factor * column[j];
    add_multiple(x, float(unit * factor), space.directions + k * floats, floats);
  }
}

// The residual of a right-hand side, and where it leads.
struct Residual {
  float *b, *lead;  // r and M^-1 r
  double shares[directions_max];
  double left, before;  // largest component of M^-1 r, now and a round ago
  double target;        // of that
  int last_image;       // that its direction led to, or -1

  // Takes from it what images from `first` on have of it.
  void project(const DirectionSpace& space, int first, long floats) {
    for (int j = first; j < space.count; ++j) {
      const float *w = space.images + j * floats, *q = space.preconditioned + j * floats;
      shares[j] = product(q, b, floats);
      add_multiple(b, float(-shares[j]), w, floats);
      add_multiple(lead, float(-shares[j]), q, floats);
    }
    before = left;
    left = largest_of(lead, floats);
  }
  bool stagnates() const { return last_image >= 0 && left > stagnant * before; }
};

// Sets `of` to the residuals above their targets, and returns their number.
inline int find_unsolved(const Residual* residuals, int count, int* of) {
  int active = 0;
  for (int p = 0; p < count; ++p) {
    if (residuals[p].left > residuals[p].target) of[active++] = p;
  }
  return active;
}

// Sets the directions after the space's `count` first ones to where residuals lead.
inline void add_directions(DirectionSpace& space, const Residual* residuals, const int* of,
                           int active, long floats) {
  for (int a = 0; a < active; ++a) {
    const Residual& r = residuals[of[a]];
    const float* lead = r.stagnates() ? space.preconditioned + r.last_image * floats : r.lead;
    __builtin_memcpy(space.directions + (space.count + a) * floats, lead, sizeof(float) * floats);
  }
}

// Generalised conjugate residuals in the norm of the factor M [Saad 2003, ch. 6.9; Parks et al.
// 2006]: the residuals of all right-hand sides are the least over one space, to which each that is
// above its target adds a direction in each round.
int recycle(const ClothMatrix& matrix, const Factor& factor, const ContactRows& contact,
            DirectionSpace& space, int count, float* b, float* x, double tolerance,
            const double* targets, double* expected) {
  const FlushTiny flush;
  const long floats = 4L * matrix.nodes;
  Residual residuals[solve_group];
  const float* from[solve_group];
  float* to[solve_group];
  double units[solve_group];
  for (int p = 0; p < count; ++p) {
    admit(contact, matrix.nodes, b + p * floats);
    units[p] = scale_to_one(b + p * floats, floats);
    from[p] = b + p * floats;
    to[p] = x + p * floats;
  }
  const auto precondition_all = [&](int vectors) {
    in_groups(vectors, [&]<int group>(int first) {
      precondition<group>(factor, matrix.nodes, from + first, to + first);
    });
    for (int p = 0; p < vectors; ++p) admit(contact, matrix.nodes, to[p]);
  };
  precondition_all(count);
  int solves = count;
  for (int p = 0; p < count; ++p) {
    Residual& r = residuals[p];
    r.lead = x + p * floats;
    r.b = b + p * floats;
    r.last_image = -1;
    r.left = largest_of(r.lead, floats);
    expected[p] = units[p] * r.left;
    const double target = targets[p] / units[p];
    r.target = tolerance * r.left > target ? tolerance * r.left : target;
    r.project(space, 0, floats);
  }
  for (;;) {
    int of[solve_group];
    const int active = find_unsolved(residuals, count, of);
    if (active == 0 || space.count + active > directions_max) break;
    add_directions(space, residuals, of, active, floats);
    for (int a = 0; a < active; ++a) {
      from[a] = space.directions + (space.count + a) * floats;
      to[a] = space.images + (space.count + a) * floats;
    }
    in_groups(active, [&]<int group>(int first) {
      apply_contact_to<group>(matrix, contact, from + first, to + first);
    });
    for (int a = 0; a < active; ++a) {
      from[a] = to[a];
      to[a] = space.preconditioned + (space.count + a) * floats;
    }
    precondition_all(active);
    solves += active;
    const int first = space.count;
    if (orthonormalise(space, active, floats) == 0) break;
    for (int a = 0; a < active; ++a)
      residuals[of[a]].last_image = first + a < space.count ? first + a : space.count - 1;
    for (int p = 0; p < count; ++p) residuals[p].project(space, first, floats);
  }
  for (int p = 0; p < count; ++p)
    combine(space, floats, units[p], residuals[p].shares, x + p * floats);
  return solves;
}

}  // namespace
}  // namespace sim_core
