// Matching of pairs between iterates: warm starting of their forces, and merging of duplicates.
#pragma once

#include <vector>

#include "contact/materials.hpp"
#include "contact/pair.hpp"
#include "contact/settings.hpp"
#include "contact/surface.hpp"

namespace sim_core {

// Transfers the forces of earlier pairs, with a share of their last changes, to the pairs at hand, both sorted by kind,
// first and feature. The force of a pair that is gone goes to the new pair of the same vertex, or of one of its edges,
// whose normal is most alike: the closest feature has changed; else to the nearest pair. `exact`: under the exact law
// the proximal stiffness of pairs that stall grows.
void transfer(std::vector<Pair>& pairs, const std::vector<PairPast>& before, double share, bool exact,
              const ContactSettings& settings);

// Merges pairs at nearly the same place, as where a vertex lies on a vertex: their rows differ by rounding only and
// would contradict each other. The pair that stays has the larger distance to keep, then a force, then the smaller gap;
// it takes the forces of the others.
void merge(std::vector<Pair>& pairs, const Surface& surface, const ContactMaterials& materials,
           const ContactSettings& settings);

}  // namespace sim_core
