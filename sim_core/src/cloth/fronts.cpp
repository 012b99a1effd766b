#include "cloth/fronts.hpp"

#include <algorithm>

namespace sim_core {

FactorStorage::FactorStorage(const Pattern& bending, const Pattern& membrane, const Dissection& dissection)
    : pivot_begin(dissection.pivot_begin) {
  const int fronts = static_cast<int>(dissection.parent.size());
  children.assign(fronts, 0);
  waiting.assign(fronts, 0);
  starts.assign(fronts, 0);
  std::vector<std::vector<int>> structure(fronts), below(fronts);
  for (int f = 0; f < fronts; ++f) {
    if (dissection.parent[f] >= 0) {
      ++children[dissection.parent[f]];
      below[dissection.parent[f]].push_back(f);
    }
  }
  row_begin.push_back(0);
  entry_begin.push_back(0);
  long panel_end = 0, stack_top = 0, stack_max = 0;
  std::vector<long> held(fronts, 0);
  std::size_t local_max = 0;
  const auto pad = [](long rows) { return (rows + front_padding - 1) / front_padding * front_padding; };
  for (int f = 0; f < fronts; ++f) {
    const int first = pivot_begin[f], last = pivot_begin[f + 1];
    std::vector<int>& own = structure[f];
    for (int i = first; i < last; ++i) {
      for (int e = bending.begin[i]; e < bending.begin[i + 1]; ++e) {
        if (bending.node[e] >= last) own.push_back(bending.node[e]);
      }
    }
    for (int child : below[f]) {
      for (int j : structure[child]) {
        if (j >= last) own.push_back(j);
      }
    }
    std::sort(own.begin(), own.end());
    own.erase(std::unique(own.begin(), own.end()), own.end());
    rows.insert(rows.end(), own.begin(), own.end());
    row_begin.push_back(static_cast<int>(rows.size()));
    const auto place = [&](int node) {
      return node < last
                 ? node - first
                 : last - first + static_cast<int>(std::lower_bound(own.begin(), own.end(), node) - own.begin());
    };
    for (int child : below[f]) {
      for (int r = row_begin[child]; r < row_begin[child + 1]; ++r) {
        if (static_cast<int>(parent_row.size()) <= r) parent_row.resize(r + 1);
        parent_row[r] = place(rows[r]);
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
    const long columns = 3L * (last - first), others = 3L * static_cast<long>(own.size());
    const long ld = pad(columns) + pad(others);
    panel_begin.push_back(panel_end);
    panel_end += ld * columns;
    local_max = std::max(local_max, static_cast<std::size_t>(ld));
    const long update = pad(pad(others) * (others + 6));
    stack_max = std::max(stack_max, stack_top + update);
    for (int child : below[f]) stack_top -= held[child];
    held[f] = own.empty() ? 0 : update;
    stack_top += held[f];
    for (long c = 0; c < columns; ++c) flops += static_cast<double>(columns - c + others) * (columns - c + others);
  }
  parent_row.resize(rows.size());
  panels.assign(panel_end + 64, 0.0f);
  stack.assign(stack_max + 64, 0.0f);
  local.assign(local_max + 64, 0.0f);
}

Factor FactorStorage::view() {
  return {static_cast<int>(children.size()),
          pivot_begin.data(),
          row_begin.data(),
          rows.data(),
          parent_row.data(),
          children.data(),
          panel_begin.data(),
          entry_begin.data(),
          entry_slot.data(),
          entry_block.data(),
          entry_row.data(),
          entry_column.data(),
          panels.data(),
          stack.data(),
          waiting.data(),
          starts.data(),
          local.data()};
}

}  // namespace sim_core
