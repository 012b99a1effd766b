#include "cloth/settings.hpp"

#include <cmath>

#include "math/refusal.hpp"

namespace sim_core {
namespace {

template <class Call>
void each_constant(Constants& constants, const Call& call) {
  constants.each([&](const std::string& group, auto& settings) {
    settings.each([&](const std::string& field, auto& value) { call(group + "." + field, value); });
  });
}

void assign(double& to, const std::string&, double value) { to = value; }
void assign(int& to, const std::string& name, double value) {
  if (value != std::floor(value) || value > 1e9)
    refuse(text(name, ": must be an integer >= 1, got ", value));
  to = static_cast<int>(value);
}

}  // namespace

Constants::Constants(const std::map<std::string, double>& changed) {
  std::size_t known = 0;
  each_constant(*this, [&](const std::string& name, auto& to) {
    const auto found = changed.find(name);
    if (found == changed.end()) return;
    if (!(found->second > 0.0) || !std::isfinite(found->second)) {
      refuse(text(name, ": must be finite and > 0, got ", found->second));
    }
    assign(to, name, found->second);
    ++known;
  });
  if (known == changed.size()) return;
  const std::map<std::string, double> names = by_name();
  for (const auto& [name, value] : changed) {
    if (!names.count(name)) refuse(text("constants: there is no ", name));
  }
}

std::map<std::string, double> Constants::by_name() const {
  Constants own = *this;
  std::map<std::string, double> out;
  each_constant(own, [&](const std::string& name, auto& value) { out[name] = value; });
  return out;
}

}  // namespace sim_core
