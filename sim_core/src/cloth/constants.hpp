// Constants of the cloth solver, by group and name.
#pragma once

#include <map>
#include <string>

#include "cloth/control_settings.hpp"
#include "cloth/factor_settings.hpp"
#include "cloth/newton_settings.hpp"
#include "cloth/stepping_settings.hpp"
#include "contact/node_settings.hpp"
#include "contact/path_settings.hpp"
#include "contact/settings.hpp"
#include "contact/skeleton_settings.hpp"
#include "contact/smooth_settings.hpp"

namespace sim_core {

struct Constants {
  ContactSettings contact;
  NodeSettings node;
  PathSettings path;
  SmoothSettings smooth;
  SkeletonSettings skeleton;
  NewtonSettings newton;
  SteppingSettings stepping;
  ControlSettings control;
  FactorSettings factor;

  Constants() = default;
  // Replaces those named "group.name". Throws std::invalid_argument if there is none of that name, or where a value
  // is not above 0, or not an integer >= 1 for a count.
  explicit Constants(const std::map<std::string, double>& changed);
  std::map<std::string, double> by_name() const;
};

}  // namespace sim_core
