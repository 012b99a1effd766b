// Sheets and surfaces that may touch: thickness and friction, triangles, and how these turn in a
// step.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <vector>

#include "contact/closest.hpp"
#include "contact/constants.hpp"
#include "contact/friction_cones.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// Of sheets and, after them, surfaces.
struct ContactMaterials {
  std::vector<double> thickness;  // m: two keep the mean of theirs apart
  Eigen::MatrixXd mu;             // of each two; negative: they do not touch each other
  int sheets;                     // that come before the surfaces
  // Shares of the thickness that edges of two sheets, and vertices of the later over triangles of
  // the earlier, keep. Where sheets lie flat on each other, these pairs are redundant to those of
  // the earlier sheet's vertices: the active set is not unique and changes all the time. With less
  // than 1 they are active where cloth is curved only.
  double edge_fraction = 1.0, second_fraction = 1.0;
  Eigen::MatrixXd mu_static = {};  // as `mu`, and at least that; empty: the same

  double friction(int a, int b, Cone cone) const {
    return cone == Cone::resting && mu_static.size() > 0 ? mu_static(a, b) : mu(a, b);
  }
  // Whether friction of these two, or of any two, is larger while they rest.
  bool has_static(int a, int b) const { return mu_static.size() > 0 && mu_static(a, b) > mu(a, b); }
  bool has_static() const { return mu_static.size() > 0 && (mu_static.array() > mu.array()).any(); }
  double mean(int a, int b) const { return 0.5 * (thickness[a] + thickness[b]); }
  // Distance that pairs of closest points keep, m. Nodes touch surfaces by themselves
  // (contact/state.hpp): pairs only hold what comes nearer between the nodes.
  double rest_distance(int a, int b) const {
    return (std::max(a, b) < sheets ? 1.0 : pairs::surface_fraction) * mean(a, b);
  }
  // The same by kind of pair; `first` and `second`: sheets of its pieces.
  double rest_distance(PairKind kind, int first, int second) const {
    const bool other = first != second && std::max(first, second) < sheets;
    const double fraction = !other                        ? 1.0
                            : kind == PairKind::edge_edge ? edge_fraction
                            : first > second              ? second_fraction
                                                          : 1.0;
    return fraction * rest_distance(first, second);
  }
  // The largest of these; without any, the largest thickness of a sheet.
  double farthest() const {
    double out = 0.0;
    if ((mu.array() < 0.0).all()) {
      return *std::max_element(thickness.begin(), thickness.begin() + sheets);
    }
    const int count = static_cast<int>(thickness.size());
    for (int a = 0; a < count; ++a) {
      for (int b = 0; b <= a; ++b) out = mu(a, b) < 0.0 ? out : std::max(out, rest_distance(a, b));
    }
    return out;
  }
};

using CollisionMask = Eigen::Matrix<bool, Eigen::Dynamic, Eigen::Dynamic>;

// Triangles that may touch: their corners, edges, and what lies around each.
struct Surface {
  std::vector<std::array<int, 3>> triangles;       // nodes
  std::vector<std::array<int, 2>> edges;           // nodes, the lower first; ascending
  std::vector<std::array<int, 3>> triangle_edges;  // opposite corner 0, 1, 2
  std::vector<int> vertices;                       // nodes that are corners, ascending
  std::vector<int> triangles_of_edge;              // counts
  std::vector<int> around_begin, around;           // triangles around each node, ascending
  std::vector<int> sheet_of_node;
  CollisionMask collides;          // whether two sheets touch each other
  std::vector<int> last_collider;  // by sheet: the last node that it touches

  Surface(std::vector<std::array<int, 3>> triangles, std::vector<int> sheet_of_node,
          CollisionMask collides);
  bool may_touch(int node, int other) const {
    return collides(sheet_of_node[node], sheet_of_node[other]);
  }
};

// How a surface turns in a step: a rotation at each node, so that what wanders over the surface is
// carried by one that changes without a jump from one triangle to the next.
//
// A triangle turns by Q Q0^T, with Q = [a, n x a, n] of its first side and its normal where it was
// expected, and Q0 the same at the start. A node turns by the mean over the triangles around it.
// That is no rotation where these turn unlike, but what it carries is as short as cloth is thick,
// and it is one where the surface moves rigidly.
//
// The end of the step is taken as velocities lead there, lest a law that carries by it should have
// derivatives by all nodes around: what this misses is of the order dt^2, and none of it is left
// where motion ends. Turns of free nodes that are large fade out.
class Turns {
 public:
  // A step begins at `start` and is expected to end at `expected`. The nodes behind the free ones
  // go there surely.
  void begin(const Buffer<double>& start, const Buffer<double>& expected, int free_nodes);
  const Eigen::Matrix3d& of(const Surface& surface, int node);

 private:
  const Eigen::Matrix3d& turn_of(const Surface& surface, int triangle);

  struct Turn {
    int step = 0;  // to which it belongs
    Eigen::Matrix3d turn;
  };
  std::vector<Turn> triangles_, nodes_;
  Buffer<double> start_, expected_;
  int step_ = 0, free_nodes_ = 0;
};

}  // namespace sim_core
