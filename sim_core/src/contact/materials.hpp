// Thickness and friction of sheets and surfaces in contact.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <vector>

#include "contact/closest.hpp"

namespace sim_core {

// What cloth touches of a body by pairs alone, or besides its vertices.
struct Bone {
  int body;
  double radius;  // m: what pairs keep apart
  bool whole;     // see Skeleton
};

// Of sheets and, after them, surfaces and skeletons.
struct ContactMaterials {
  std::vector<double> thickness;  // m: two keep the mean of theirs apart
  Eigen::MatrixXd mu;             // of each two; negative: they do not touch each other
  int sheets;                     // that come before the surfaces
  // Shares of the thickness that edges of two sheets, and vertices of the later over triangles of the earlier, keep.
  // Where sheets lie flat on each other, these pairs are redundant to those of the earlier sheet's vertices: the active
  // set is not unique and changes all the time. With less than 1 they are active where cloth is curved only.
  double edge_share = 1.0, second_share = 1.0;
  double surface_share = 0.25;  // what pairs with surfaces keep of it: see ContactSettings
  double cell = 0.0;            // m: side of a cell, of the coarsest sheet
  std::vector<Bone> bones;

  int first_bone() const { return static_cast<int>(thickness.size()); }
  // Of two sheets, surfaces and skeletons: the skeleton, or null.
  const Bone* bone_of(int a, int b) const {
    const int last = std::max(a, b) - first_bone();
    return last < 0 ? nullptr : &bones[last];
  }
  double mean(int a, int b) const { return 0.5 * (thickness[a] + thickness[b]); }
  // Distance that pairs of closest points keep, m. Nodes touch surfaces by themselves (contact/smooth.hpp): pairs only
  // hold what comes nearer between the nodes.
  double apart(int a, int b) const {
    if (const Bone* bone = bone_of(a, b)) return bone->radius;
    return (std::max(a, b) < sheets ? 1.0 : surface_share) * mean(a, b);
  }
  // The same by kind of pair; `first` and `second`: sheets of its pieces.
  double apart(PairKind kind, int first, int second) const {
    const bool other = first != second && std::max(first, second) < sheets;
    const double share = !other ? 1.0 : kind == PairKind::edge_edge ? edge_share : first > second ? second_share : 1.0;
    return share * apart(first, second);
  }
  // The largest of these without skeletons; without any, the largest thickness of a sheet.
  double farthest() const {
    double out = 0.0;
    if ((mu.topLeftCorner(first_bone(), first_bone()).array() < 0.0).all()) {
      return *std::max_element(thickness.begin(), thickness.begin() + sheets);
    }
    for (int a = 0; a < first_bone(); ++a) {
      for (int b = 0; b <= a; ++b) out = mu(a, b) < 0.0 ? out : std::max(out, apart(a, b));
    }
    return out;
  }
};

}  // namespace sim_core
