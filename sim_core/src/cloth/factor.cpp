#include "cloth/factor.hpp"

#include <algorithm>

namespace sim_core {
namespace {

// Subtrees of fewer nodes are made anew as one piece.
constexpr int piece_nodes = 48;
// Lengths of step that alternate: of late, and half and twice as long.
constexpr std::size_t pool_max = 3;

// Floats of the tiles of a front.
long front_floats(long columns, long others) {
  long floats = 0;
  for (long j = 0; j < columns; j += tile_columns) {
    const long width = std::min<long>(tile_columns, columns - j);
    floats += tile_floats(width, columns + others - j - width);
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

}  // namespace

FactorStorage::FactorStorage(const Pattern& bending, const Pattern& membrane,
                             const Dissection& dissection)
    : piece(pieces_of(dissection)),
      due(piece.size(), 1),
      work(piece.size(), 0.0),
      pivot_begin(dissection.pivot_begin) {
  const int fronts = static_cast<int>(dissection.parent.size());
  std::vector<std::vector<int>> structure(fronts), below(fronts);
  for (int f = 0; f < fronts; ++f) {
    if (dissection.parent[f] >= 0) below[dissection.parent[f]].push_back(f);
  }
  std::vector<std::vector<FrontRun>> runs_of(fronts);
  row_begin.push_back(0);
  entry_begin.push_back(0);
  tile_begin.push_back(0);
  child_begin.push_back(0);
  Shelf shelf;
  long update_floats = 0, panel_max = 0, local_max = 0;
  const auto pad = [](long rows) {
    return (rows + front_padding - 1) / front_padding * front_padding;
  };
  for (int f = 0; f < fronts; ++f) {
    const int first = pivot_begin[f], last = pivot_begin[f + 1];
    std::vector<int>& front_rows = structure[f];
    for (int i = first; i < last; ++i) {
      for (int e = bending.begin[i]; e < bending.begin[i + 1]; ++e) {
        if (bending.node[e] >= last) front_rows.push_back(bending.node[e]);
      }
    }
    for (int child : below[f]) {
      for (int j : structure[child]) {
        if (j >= last) front_rows.push_back(j);
      }
    }
    std::sort(front_rows.begin(), front_rows.end());
    front_rows.erase(std::unique(front_rows.begin(), front_rows.end()), front_rows.end());
    rows.insert(rows.end(), front_rows.begin(), front_rows.end());
    row_begin.push_back(static_cast<int>(rows.size()));
    const auto place = [&](int node) {
      return node < last ? node - first
                         : last - first +
                               static_cast<int>(
                                   std::lower_bound(front_rows.begin(), front_rows.end(), node) -
                                   front_rows.begin());
    };
    for (int child : below[f]) {
      const std::vector<int>& theirs = structure[child];
      for (int r = 0; r < static_cast<int>(theirs.size()); ++r) {
        const int at = place(theirs[r]);
        std::vector<FrontRun>& out = runs_of[child];
        // A run does not lead from the pivots to the other rows, which are padded apart.
        if (!out.empty() && at == out.back().place + out.back().count && at != last - first) {
          ++out.back().count;
        } else {
          out.push_back({r, 1, at});
        }
      }
    }
    for (int j = first; j < last; ++j) {
      for (int e = bending.begin[j]; e < bending.begin[j + 1]; ++e) {
        const int i = bending.node[e];
        if (i < j) continue;
        entry_slot.push_back(e);
        // Column j of the front holds K_ij: the block in row i of the matrix.
        entry_block.push_back(membrane.slot(i, j));
        entry_row.push_back(place(i));
        entry_column.push_back(j - first);
      }
    }
    entry_begin.push_back(static_cast<long>(entry_slot.size()));
    const long columns = 3L * (last - first), others = 3L * static_cast<long>(front_rows.size());
    const long ld = pad(columns) + pad(others);
    tile_begin.push_back(tile_begin.back() + front_floats(columns, others));
    panel_max = std::max(panel_max, ld * columns);
    local_max = std::max(local_max, columns + others);
    const long update = pad(others) * others;
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
    for (long c = 0; c < columns; ++c)
      work[f] += static_cast<double>(columns - c + others) * (columns - c + others);
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
  local.assign(local_max + 64, 0.0f);
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
  const double share = storage_.mark(touched_);
  refresh(assembly, contact);
  return share;
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
    contact.penalty(i, assembly.own_stiffness(i), &added_[6L * i]);
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
