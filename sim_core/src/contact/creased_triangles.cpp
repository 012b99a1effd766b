#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

#include "contact/pn_triangles.hpp"

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Sets of corners that are joined one by one.
struct Joined {
  std::vector<int> parent;
  explicit Joined(std::size_t count) : parent(count) { std::iota(parent.begin(), parent.end(), 0); }
  int root(int i) {
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
  }
  void join(int i, int j) { parent[std::max(root(i), root(j))] = std::min(root(i), root(j)); }
};

}  // namespace

CreasedTriangles::CreasedTriangles(std::vector<std::array<int, 3>> triangles_in,
                                   const Buffer<double>& x, const std::vector<double>& crease)
    : triangles(std::move(triangles_in)), around_begin(x.size() / 4 + 1, 0) {
  const int count = static_cast<int>(triangles.size());
  Sides sides;
  for (int t = 0; t < count; ++t) {
    for (int k = 0; k < 3; ++k) {
      const int i = triangles[t][next(k)], j = triangles[t][after_next(k)];
      sides[{std::min(i, j), std::max(i, j)}].push_back(t);
    }
  }
  orient(sides);
  find_sharp(sides, x, crease);
  for (const auto& corners : triangles) {
    for (int node : corners) ++around_begin[node + 1];
  }
  std::partial_sum(around_begin.begin(), around_begin.end(), around_begin.begin());
  around.resize(around_begin.back());
  std::vector<int> place(around_begin.begin(), around_begin.end() - 1);
  for (int t = 0; t < count; ++t) {
    for (int node : triangles[t]) around[place[node]++] = t;
  }
}

int CreasedTriangles::corner_of(int t, int node) const {
  return static_cast<int>(std::find(triangles[t].begin(), triangles[t].end(), node) -
                          triangles[t].begin());
}

// Whether i comes before j in the triangle.
bool CreasedTriangles::runs(int t, int i, int j) const {
  return triangles[t][next(corner_of(t, i))] == j;
}

// The triangle over the edge opposite a corner; -1 if there is none or more than one.
int CreasedTriangles::other(const Sides& sides, int t, int k) const {
  const int i = triangles[t][next(k)], j = triangles[t][after_next(k)];
  const std::vector<int>& edge = sides.at({std::min(i, j), std::max(i, j)});
  return edge.size() == 2 ? edge[edge[0] == t] : -1;
}

void CreasedTriangles::orient(const Sides& sides) {
  std::vector<char> visited(triangles.size(), 0);
  for (std::size_t first = 0; first < triangles.size(); ++first) {
    if (visited[first]) continue;
    std::vector<int> queue{static_cast<int>(first)};
    visited[first] = 1;
    for (std::size_t q = 0; q < queue.size(); ++q) {
      const int t = queue[q];
      for (int k = 0; k < 3; ++k) {
        const int beyond = other(sides, t, k);
        if (beyond < 0 || visited[beyond]) continue;
        visited[beyond] = 1;
        if (runs(beyond, triangles[t][next(k)], triangles[t][after_next(k)])) {
          std::swap(triangles[beyond][1], triangles[beyond][2]);
        }
        queue.push_back(beyond);
      }
    }
  }
}

void CreasedTriangles::find_sharp(const Sides& sides, const Buffer<double>& x,
                                  const std::vector<double>& crease) {
  const int count = static_cast<int>(triangles.size());
  across.assign(count, {-1, -1, -1});
  sharp.assign(count, {1, 1, 1});
  Joined joined(3 * static_cast<std::size_t>(count));
  for (int t = 0; t < count; ++t) {
    for (int k = 0; k < 3; ++k) {
      const int beyond = across[t][k] = other(sides, t, k);
      if (beyond < 0) continue;
      const int i = triangles[t][next(k)], j = triangles[t][after_next(k)];
      const Vector3d a = facet_normal(x, t), b = facet_normal(x, beyond);
      const double angle = std::atan2(a.cross(b).norm(), a.dot(b));
      if (runs(beyond, i, j) || angle > std::min(crease[t], crease[beyond])) continue;
      sharp[t][k] = 0;
      for (int node : {i, j})
        joined.join(3 * t + corner_of(t, node), 3 * beyond + corner_of(beyond, node));
    }
  }
  std::vector<int> number(3 * static_cast<std::size_t>(count), -1);
  group.resize(count);
  for (int c = 0; c < 3 * count; ++c) {
    int& of_root = number[joined.root(c)];
    if (of_root < 0) of_root = groups++;
    group[c / 3][c % 3] = of_root;
  }
}

Vector3d CreasedTriangles::facet_normal(const Buffer<double>& x, int t) const {
  const auto& c = triangles[t];
  return (at_node(x, c[1]) - at_node(x, c[0]))
      .cross(at_node(x, c[2]) - at_node(x, c[0]))
      .normalized();
}

}  // namespace sim_core
