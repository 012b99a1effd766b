// Which terms of a sensitivity a cloth has.
#include "cloth/sensitivities.hpp"
#include "math/refusal.hpp"

namespace sim_core {

void refuse_unknown(const SensitivityTerm& term, const Eigen::MatrixXd& mu, int sheets) {
  using Kind = SensitivityTerm::Kind;
  if (term.is_friction_of_pair()) {
    const bool known = term.first >= 0 && term.second < mu.rows();
    if (!known || !(mu(term.first, term.second) >= 0.0)) {
      refuse(text("parameter: friction must be of two sheets, or of a sheet and a surface, that ",
                  "touch each other, got ", term.first, " and ", term.second));
    }
    return;
  }
  const int sheet = term.is_friction_of_body() ? term.second : term.first;
  if (sheet >= sheets)
    refuse(text("parameter: must be of one of ", sheets, " sheets, got sheet ", sheet));
}

}  // namespace sim_core
