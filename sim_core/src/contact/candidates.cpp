#include <Eigen/Geometry>
#include <algorithm>

#include "contact/path.hpp"

namespace sim_core {
namespace {

using Eigen::Array3d;
using Box = Eigen::AlignedBox3d;

template <std::size_t count>
Box box_of(const std::array<int, count>& nodes, const Buffer<double>& x, double reach) {
  Box box;
  for (int node : nodes) box.extend(at_node(x, node));
  box.min().array() -= reach;
  box.max().array() += reach;
  return box;
}

// Boxes sorted into cells; cell c holds items[begin[c]] ... , ascending.
class Grid {
 public:
  explicit Grid(const std::vector<Box>& boxes) {
    Box all;
    double extent = 0.0;
    for (const Box& box : boxes) {
      all.extend(box);
      extent += box.diagonal().maxCoeff();
    }
    low_ = all.min().array();
    size_ = extent / static_cast<double>(boxes.size());
    const double cells_max = cells_per_item * static_cast<double>(boxes.size()) + 64.0;
    while ((((all.max().array() - low_) / size_).floor() + 1.0).prod() > cells_max) size_ *= 1.25;
    count_ = (((all.max().array() - low_) / size_).floor() + 1.0).cast<int>();
    begin_.assign(static_cast<std::size_t>(count_.prod()) + 1, 0);
    for (const Box& box : boxes) visit(box, [&](int cell) { ++begin_[cell + 1]; });
    for (std::size_t c = 1; c < begin_.size(); ++c) begin_[c] += begin_[c - 1];
    items_.resize(begin_.back());
    std::vector<int> next(begin_.begin(), begin_.end() - 1);
    for (std::size_t i = 0; i < boxes.size(); ++i) {
      visit(boxes[i], [&](int cell) { items_[next[cell]++] = static_cast<int>(i); });
    }
  }

  int cells() const { return static_cast<int>(begin_.size()) - 1; }
  // -1 outside.
  int cell_at(const Array3d& p) const {
    const Eigen::Array3i at = place(p);
    return (at >= 0).all() && (at < count_).all() ? index(at) : -1;
  }
  const int* begin(int cell) const { return items_.data() + begin_[cell]; }
  const int* end(int cell) const { return items_.data() + begin_[cell + 1]; }

 private:
  // Bounds memory where boxes lie far apart. Results are the same for any number.
  static constexpr double cells_per_item = 8.0;

  Eigen::Array3i place(const Array3d& p) const { return ((p - low_) / size_).floor().cast<int>(); }
  int index(const Eigen::Array3i& at) const {
    return (at[2] * count_[1] + at[1]) * count_[0] + at[0];
  }
  template <class Call>
  void visit(const Box& box, const Call& call) const {
    const Eigen::Array3i from = place(box.min().array()), to = place(box.max().array());
    for (int z = from[2]; z <= to[2]; ++z) {
      for (int y = from[1]; y <= to[1]; ++y) {
        for (int x = from[0]; x <= to[0]; ++x) call((z * count_[1] + y) * count_[0] + x);
      }
    }
  }

  Array3d low_;
  double size_ = 0.0;
  Eigen::Array3i count_;
  std::vector<int> begin_, items_;
};

// The boxes of a cell, one coordinate after the other, so that one is compared with many at a time.
class Around {
 public:
  void take(const std::vector<Box>& boxes, const int* begin, const int* end) {
    for (int c = 0; c < 3; ++c) {
      low_[c].clear();
      high_[c].clear();
      for (const int* i = begin; i < end; ++i) {
        low_[c].push_back(boxes[*i].min()[c]);
        high_[c].push_back(boxes[*i].max()[c]);
      }
    }
    meet_.resize(static_cast<std::size_t>(end - begin));
  }
  // Returns of each item whether it meets the given one, for those after that.
  const std::vector<char>& meeting(int item) {
    const double *low = low_[0].data(), *low_y = low_[1].data(), *low_z = low_[2].data(),
                 *high = high_[0].data(), *high_y = high_[1].data(), *high_z = high_[2].data();
    char* meet = meet_.data();
    const int count = static_cast<int>(meet_.size());
    for (int j = item + 1; j < count; ++j) {
      meet[j] = (low[item] <= high[j]) & (low[j] <= high[item]) & (low_y[item] <= high_y[j]) &
                (low_y[j] <= high_y[item]) & (low_z[item] <= high_z[j]) &
                (low_z[j] <= high_z[item]);
    }
    return meet_;
  }

 private:
  std::array<std::vector<double>, 3> low_, high_;
  std::vector<char> meet_;
};

void add_if_near(std::vector<Candidate>& out, Candidate pair, const Buffer<double>& x,
                 double reach) {
  const FourPoints at = points_of(pair, x);
  pair.distance = between_closest(closest_weights(pair.kind, at), at).norm();
  if (pair.distance <= reach) out.push_back(pair);
}

bool in_order(const Candidate& p, const Candidate& q) {
  return p.first != q.first ? p.first < q.first : p.second < q.second;
}

void add_vertices(const Surface& surface, const Buffer<double>& x, double reach,
                  const std::vector<Box>& boxes, std::vector<Candidate>& out) {
  const Grid grid(boxes);
  for (const int vertex : surface.vertices) {
    const int cell = grid.cell_at(at_node(x, vertex).array());
    if (cell < 0) continue;
    for (const int* t = grid.begin(cell); t < grid.end(cell); ++t) {
      const auto& corner = surface.triangles[*t];
      if (!boxes[*t].contains(at_node(x, vertex)) || !surface.may_touch(vertex, corner[0]))
        continue;
      if (std::find(corner.begin(), corner.end(), vertex) != corner.end()) continue;
      add_if_near(
          out,
          {PairKind::vertex_triangle, vertex, *t, {vertex, corner[0], corner[1], corner[2]}, 0.0},
          x, reach);
    }
  }
}

bool have_common_end(const std::array<int, 2>& a, const std::array<int, 2>& b) {
  return a[0] == b[0] || a[0] == b[1] || a[1] == b[0] || a[1] == b[1];
}

void add_edges(const Surface& surface, const Buffer<double>& x, double reach,
               const std::vector<Box>& boxes, std::vector<Candidate>& out) {
  const Grid grid(boxes);
  Around around;
  for (int cell = 0; cell < grid.cells(); ++cell) {
    const int *begin = grid.begin(cell), *end = grid.end(cell);
    around.take(boxes, begin, end);
    for (const int* i = begin; i < end; ++i) {
      const auto& a = surface.edges[*i];
      if (a[0] > surface.last_collider[surface.sheet_of_node[a[0]]])
        continue;  // nothing beyond touches it
      const std::vector<char>& meet = around.meeting(static_cast<int>(i - begin));
      for (const int* j = i + 1; j < end; ++j) {
        if (!meet[j - begin]) continue;
        const auto& b = surface.edges[*j];
        if (!surface.may_touch(a[0], b[0]) || have_common_end(a, b)) continue;
        // Boxes that meet in many cells count in the one with the lowest corner of what they share.
        if (grid.cell_at(boxes[*i].min().cwiseMax(boxes[*j].min()).array()) != cell) continue;
        add_if_near(out, {PairKind::edge_edge, *i, *j, {a[0], a[1], b[0], b[1]}, 0.0}, x, reach);
      }
    }
  }
}

}  // namespace

FourPoints points_of(const Candidate& pair, const Buffer<double>& x) {
  return {at_node(x, pair.node[0]), at_node(x, pair.node[1]), at_node(x, pair.node[2]),
          at_node(x, pair.node[3])};
}

std::vector<Candidate> candidates(const Surface& surface, const Buffer<double>& x, double reach) {
  std::vector<Candidate> out;
  std::vector<Box> boxes;
  for (const auto& corners : surface.triangles) boxes.push_back(box_of(corners, x, reach));
  if (boxes.empty() || !std::all_of(boxes.begin(), boxes.end(), [](const Box& box) {
        return box.min().allFinite() && box.max().allFinite();
      })) {
    return out;
  }
  add_vertices(surface, x, reach, boxes, out);
  const std::size_t vertex_pairs = out.size();
  boxes.clear();
  for (const auto& ends : surface.edges) boxes.push_back(box_of(ends, x, 0.5 * reach));
  add_edges(surface, x, reach, boxes, out);
  std::sort(out.begin() + static_cast<std::ptrdiff_t>(vertex_pairs), out.end(), in_order);
  return out;
}

}  // namespace sim_core
