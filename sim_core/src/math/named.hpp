// Structs whose members can be visited by name.
#pragma once

#include <algorithm>
#include <string>
#include <string_view>

namespace sim_core {

// Calls with each of the `names`, which are separated by commas, and its value.
template <class Call, class... Values>
void each_named(std::string_view names, const Call& call, Values&... values) {
  const auto next = [&] {
    const std::string name(names.substr(0, names.find(',')));
    names.remove_prefix(std::min(name.size() + 2, names.size()));
    return name;
  };
  (call(next(), values), ...);
}

}  // namespace sim_core

// Within a struct: its members, in this order.
#define SIM_CORE_NAMED(...)                                \
  template <class Call>                                    \
  void each(const Call& call) {                            \
    sim_core::each_named(#__VA_ARGS__, call, __VA_ARGS__); \
  }
