// Contacts of the cloth's nodes with the smooth surfaces through the vertices of prescribed triangles.
//
// A node keeps half of both thicknesses away from the surface and touches it as it touches a body, by one normal and
// one gap. Where the surface is so curved that the triangles between nodes would cut into it, nodes keep further away:
// a triangle in a circle of radius r sinks by r^2 kappa/2 below its corners on a surface of curvature kappa. A node
// stays on the side of the triangles on which it is when a step begins. What nodes do not catch, triangles that poke
// through between them, is left to pairs of closest points.
#pragma once

#include <Eigen/Core>
#include <limits>
#include <optional>
#include <vector>

#include "contact/closest.hpp"
#include "contact/pn_triangles.hpp"
#include "contact/surface.hpp"

namespace sim_core {

struct SmoothTouch {
  double gap;              // m
  Eigen::Vector3d normal;  // towards the cloth
  int surface;
};

class SmoothContact {
 public:
  // `triangles`: nodes; `sheet_of_node`: of cloth, and after them surfaces. `crease`: of each surface, see
  // CreasedTriangles. x: where the surfaces are. `radius`: of the circle around the largest triangle at each free node,
  // m.
  SmoothContact(std::vector<std::array<int, 3>> triangles, std::vector<int> sheet_of_node,
                const ContactMaterials& materials, const std::vector<double>& crease, const Buffer<double>& x,
                const std::vector<double>& radius, const SmoothSettings& settings);

  // Forgets which triangles are touched.
  void restart();
  // An attempt at a step begins at `start`; it takes the surfaces to `ends`, and the cloth to about `guess`.
  void begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& guess);
  // A step ended, with these nodes in contact.
  void keep(const std::vector<int>& mode);

  // What a node sees at p, if a surface is near.
  std::optional<SmoothTouch> touch(int node, const Eigen::Vector3d& p);
  // How far a node that was at `before` when the step began was too near then, if by more than `allowed`, m.
  Eigen::Vector3d forced(int node, const Eigen::Vector3d& before, double allowed) const;
  // Of what the node saw last: its way over the surface since it was at `before` when the step began, m; friction; and
  // the foot.
  Eigen::Vector3d slip(int node, const Eigen::Vector3d& before, const Eigen::Vector3d& p) const;
  double mu(int node) const;
  const Foot& foot(int node) const { return feet_[node]; }
  const std::vector<std::array<int, 3>>& triangles() const { return patches_.triangles(); }

 private:
  void take_shapes(const Buffer<double>& start, const Buffer<double>& ends);
  int surface_of(int triangle) const { return sheet_of_node_[patches_.triangles()[triangle][0]]; }

  double apart(const PatchShape& shape, int node, const Foot& foot) const;

  std::vector<int> sheet_of_node_;
  std::vector<double> radius_;
  int free_nodes_;
  int first_ = std::numeric_limits<int>::max();  // of the surfaces' nodes, which are the last
  ContactMaterials materials_;
  SmoothSettings settings_;
  PNTriangles patches_;
  TriangleTree tree_;
  PatchShape start_, end_;
  struct Track {
    std::vector<int> triangle;  // (free nodes): -1: none is near
    std::vector<double> side;
  };
  Track track_, kept_;
  std::vector<Foot> feet_;
};

}  // namespace sim_core
