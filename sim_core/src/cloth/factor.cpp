#include "cloth/factor.hpp"

#include <algorithm>
#include <iterator>

namespace sim_core {
namespace {

// Subtrees of fewer nodes are made anew as one piece.
constexpr int piece_nodes = 48;
// Lengths of step that alternate: of late, and half and twice as long.
constexpr std::size_t pool_max = 3;

// Floats of the tiles of a front.
long front_floats(long columns, long rows) {
  long floats = 0;
  for (long j = 0; j < columns; j += tile_columns) {
    const long width = std::min<long>(tile_columns, columns - j);
    floats += tile_floats(width, columns + rows - j - width);
  }
  return floats;
}

// Of each front, that with which it is made anew.
std::vector<int> pieces_of(const Dissection& dissection) {
  const int fronts = static_cast<int>(dissection.parent.size());
  std::vector<int> nodes(fronts), piece(fronts);
  for (int f = 0; f < fronts; ++f) {
    nodes[f] += dissection.pivot_begin[f + 1] - dissection.pivot_begin[f];
    if (dissection.parent[f] >= 0) nodes[dissection.parent[f]] += nodes[f];
  }
  for (int f = fronts - 1; f >= 0; --f) {
    const int parent = dissection.parent[f];
    piece[f] = parent < 0 || nodes[parent] >= piece_nodes ? f : piece[parent];
  }
  return piece;
}

// Where things of some length lie that come and go: each in the first gap that holds it.
struct Shelf {
  struct Item {
    int name;
    long begin, end;
  };
  std::vector<Item> items;  // in their order on it
  long length = 0;

  long put(int name, long size) {
    long begin = 0;
    auto next = items.begin();
    while (next != items.end() && next->begin - begin < size) begin = (next++)->end;
    items.insert(next, {name, begin, begin + size});
    length = std::max(length, begin + size);
    return begin;
  }
  void take(int name) {
    items.erase(std::find_if(items.begin(), items.end(),
                             [&](const Item& item) { return item.name == name; }));
  }
};

long pad(long rows) { return (rows + front_padding - 1) / front_padding * front_padding; }

// The nodes of a front: pivots, and the rows below them, ascending.
struct FrontNodes {
  int first, last;  // pivots
  std::vector<int> rows;

  int pivots() const { return last - first; }
  // Place of a node among the pivots and then the rows.
  int place(int node) const {
    if (node < last) return node - first;
    return pivots() +
           static_cast<int>(std::lower_bound(rows.begin(), rows.end(), node) - rows.begin());
  }
};

void add_later(std::vector<int>::const_iterator begin, std::vector<int>::const_iterator end,
               FrontNodes& front) {
  std::copy_if(begin, end, std::back_inserter(front.rows),
               [&](int node) { return node >= front.last; });
}

// Rows are the nodes after the pivots that a pivot, or a row of a child, is coupled to.
FrontNodes front_nodes(int first, int last, const Pattern& bending,
                       const std::vector<int>& children, const std::vector<FrontNodes>& fronts) {
  FrontNodes front{first, last, {}};
  add_later(bending.node.begin() + bending.begin[first], bending.node.begin() + bending.begin[last],
            front);
  for (int child : children) add_later(fronts[child].rows.begin(), fronts[child].rows.end(), front);
  std::sort(front.rows.begin(), front.rows.end());
  front.rows.erase(std::unique(front.rows.begin(), front.rows.end()), front.rows.end());
  return front;
}

// Runs of a child's rows that lie together in its parent.
std::vector<FrontRun> runs_in_parent(const FrontNodes& child, const FrontNodes& parent) {
  std::vector<FrontRun> runs;
  for (int r = 0; r < static_cast<int>(child.rows.size()); ++r) {
    const int place = parent.place(child.rows[r]);
    // A run does not lead from the pivots to the other rows, which are padded apart.
    const bool goes_on =
        !runs.empty() && place == runs.back().place + runs.back().count && place != parent.pivots();
    if (goes_on) {
      ++runs.back().count;
    } else {
      runs.push_back({r, 1, place});
    }
  }
  return runs;
}

// What of the matrix comes into a front: its columns, from the diagonal down.
void add_entries(const FrontNodes& front, const Pattern& bending, const Pattern& membrane,
                 FactorStorage& storage) {
  for (int j = front.first; j < front.last; ++j) {
    for (int e = bending.begin[j]; e < bending.begin[j + 1]; ++e) {
      const int i = bending.node[e];
      if (i < j) continue;
      storage.entry_slot.push_back(e);
      // Column j of the front holds K_ij: the block in row i of the matrix.
      storage.entry_block.push_back(membrane.slot(i, j));
      storage.entry_row.push_back(front.place(i));
      storage.entry_column.push_back(j - front.first);
    }
  }
  storage.entry_begin.push_back(static_cast<long>(storage.entry_slot.size()));
}

}  // namespace

FactorStorage::FactorStorage(const Pattern& bending, const Pattern& membrane,
                             const Dissection& dissection)
    : piece(pieces_of(dissection)),
      due(piece.size(), 1),
      work(piece.size(), 0.0),
      pivot_begin(dissection.pivot_begin) {
  const int fronts = static_cast<int>(dissection.parent.size());
  std::vector<std::vector<int>> below(fronts);
  for (int f = 0; f < fronts; ++f) {
    if (dissection.parent[f] >= 0) below[dissection.parent[f]].push_back(f);
  }
  std::vector<FrontNodes> nodes;
  std::vector<std::vector<FrontRun>> runs_of(fronts);
  row_begin.push_back(0);
  entry_begin.push_back(0);
  tile_begin.push_back(0);
  child_begin.push_back(0);
  Shelf shelf;
  long update_floats = 0, panel_max = 0, local_max = 0;
  for (int f = 0; f < fronts; ++f) {
    nodes.push_back(front_nodes(pivot_begin[f], pivot_begin[f + 1], bending, below[f], nodes));
    const FrontNodes& front = nodes.back();
    rows.insert(rows.end(), front.rows.begin(), front.rows.end());
    row_begin.push_back(static_cast<int>(rows.size()));
    for (int child : below[f]) runs_of[child] = runs_in_parent(nodes[child], front);
    add_entries(front, bending, membrane, *this);

    const long columns = 3L * front.pivots(),
               row_floats = 3L * static_cast<long>(front.rows.size());
    tile_begin.push_back(tile_begin.back() + front_floats(columns, row_floats));
    panel_max = std::max(panel_max, (pad(columns) + pad(row_floats)) * columns);
    local_max = std::max(local_max, columns + row_floats);
    for (long c = 0; c < columns; ++c)
      work[f] += static_cast<double>(columns - c + row_floats) * (columns - c + row_floats);

    // The update of a piece stays, for its parent may be made anew without it. Others lie on a
    // shelf, until their parents have taken them.
    const long update = pad(row_floats) * row_floats;
    if (piece[f] == f) {
      update_begin.push_back(update_floats);
      update_floats += update;
    } else {
      update_begin.push_back(shelf.put(f, update));
    }
    for (int child : below[f]) {
      if (piece[child] != child) shelf.take(child);
    }
    children.insert(children.end(), below[f].begin(), below[f].end());
    child_begin.push_back(static_cast<int>(children.size()));
  }
  run_begin.push_back(0);
  for (const std::vector<FrontRun>& front_runs : runs_of) {
    runs.insert(runs.end(), front_runs.begin(), front_runs.end());
    run_begin.push_back(static_cast<int>(runs.size()));
  }
  for (std::size_t f = 0; f < piece.size(); ++f) {
    if (piece[f] != static_cast<int>(f)) update_begin[f] += update_floats;
  }
  tiles.assign(tile_begin.back() + 64, 0.0f);
  panel.assign(panel_max + 64, 0.0f);
  updates.assign(update_floats + shelf.length + 64, 0.0f);
  local_floats = local_max + 64;
  local.assign(solve_group * local_floats, 0.0f);
}

void FactorStorage::mark_all() { std::fill(due.begin(), due.end(), 1); }

double FactorStorage::mark(const std::vector<char>& touched) {
  const int fronts = static_cast<int>(due.size());
  std::fill(due.begin(), due.end(), 0);
  for (int f = 0; f < fronts; ++f) {
    for (int i = pivot_begin[f]; i < pivot_begin[f + 1]; ++i) due[piece[f]] |= touched[i];
    for (int c = child_begin[f]; c < child_begin[f + 1]; ++c) due[piece[f]] |= due[children[c]];
  }
  double all = 0.0, due_work = 0.0;
  for (int f = 0; f < fronts; ++f) {
    due[f] = due[piece[f]];
    all += work[f];
    if (due[f]) due_work += work[f];
  }
  return due_work / all;
}

Factor FactorStorage::view(bool half) {
  return {static_cast<int>(update_begin.size()),
          due.data(),
          pivot_begin.data(),
          row_begin.data(),
          rows.data(),
          child_begin.data(),
          children.data(),
          run_begin.data(),
          runs.data(),
          update_begin.data(),
          tile_begin.data(),
          entry_begin.data(),
          entry_slot.data(),
          entry_block.data(),
          entry_row.data(),
          entry_column.data(),
          half,
          tiles.data(),
          panel.data(),
          updates.data(),
          local.data(),
          local_floats,
          nullptr,
          nullptr};
}

StaleFactor::StaleFactor(const Numbering& numbering)
    : storage_(numbering.compact_bending, numbering.membrane, numbering.dissection),
      view_(storage_.view(storage_.tile_begin.back() >= half_from)),
      added_(6L * numbering.free_nodes, 0.0f),
      touched_(numbering.free_nodes, 0) {}

double StaleFactor::renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact,
                          double dt, const ClothSettings& settings) {
  if (!age.exists() || age.too_much(settings)) {
    make(assembly, x, contact, dt);
    return 1.0;
  }
  if (contact.mode == modes_) return 0.0;
  for (std::size_t i = 0; i < touched_.size(); ++i) touched_[i] = contact.mode[i] != modes_[i];
  const double fraction = storage_.mark(touched_);
  refresh(assembly, contact);
  return fraction;
}

void StaleFactor::make(Assembly& assembly, const Buffer<double>& x, const ContactState& contact,
                       double dt) {
  storage_.mark_all();
  matrix_ = assembly.neighbour(x, numbers_);
  refresh(assembly, contact);
  age.restart(dt);
}

void StaleFactor::refresh(const Assembly& assembly, const ContactState& contact) {
  for (int i = 0; i < assembly.numbering.free_nodes; ++i)
    contact.factor_block(i, assembly.own_stiffness(i), &added_[6L * i]);
  assembly.kernel.factor(view_, matrix_, added_.data());
  modes_ = contact.mode;
}

void FactorAge::spent(int iterations) {
  last_ = iterations;
  if (fresh_ < 0) fresh_ = last_, excess_ = 0;
  excess_ += std::max(0, last_ - fresh_);
}

FactorPool::FactorPool(const Numbering& numbering) : numbering_(numbering) {
  factors_.push_back(std::make_unique<StaleFactor>(numbering));
}

StaleFactor& FactorPool::of(double dt) {
  std::size_t place = 0;
  while (place < factors_.size() && !factors_[place]->age.fits(dt)) ++place;
  if (place == factors_.size()) {
    if (place < pool_max) {
      factors_.push_back(std::make_unique<StaleFactor>(numbering_));
    } else {
      --place;
      factors_[place]->age.forget();
    }
  }
  std::rotate(factors_.begin(), factors_.begin() + place, factors_.begin() + place + 1);
  return *factors_.front();
}

}  // namespace sim_core
