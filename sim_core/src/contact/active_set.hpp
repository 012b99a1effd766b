// The active set of pairs: the law's own at the first iterate, and corrections of it within a linear problem.
#pragma once

#include <vector>

#include "contact/pair.hpp"
#include "contact/settings.hpp"

namespace sim_core {

// After the first look of a step: activates pairs that have a force and are open by no more than what a prediction on
// straight lines opens over curved cloth. Returns whether there are any.
bool resume(std::vector<Pair>& pairs, const ContactSettings& settings);

// After a linear problem: releases added pairs that would pull, and adds pairs that would come too near, vertices
// before edges. Returns whether the active set has changed.
bool activate(std::vector<Pair>& pairs, const Buffer<float>& change, int free_nodes, const ContactSettings& settings);

}  // namespace sim_core
