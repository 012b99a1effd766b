// Looks at every step that was taken, and measures what the checks of a run judge.
#pragma once

#include <optional>
#include <vector>

#include "cloth/newton.hpp"
#include "contact/cores.hpp"

namespace sim_core {

// A step that was taken.
struct StepTaken {
  const Buffer<double>&start, &x, &v;  // (nodes, 4): positions at its start and end [m], velocities at its end [m/s]
  const Points3& gravity;              // (vertices, 3), m/s^2
  const std::vector<Body>&at_start, &at_end;
};

class Watch {
 public:
  Watch(const ClothMesh& mesh, const Assembly& assembly);

  // The state was set: the energy of the next one is the first.
  void restart() { energy_.reset(); }
  // Throws std::invalid_argument where a triangle with a free corner is deeper in a body than `inside`, m.
  void refuse_inside(const Body& body, int number, double inside, const Buffer<double>& x) const;
  // `newton`: as the step left it.
  Observed see(const StepTaken& step, const Newton& newton);

 private:
  void see_energy(const StepTaken& step, const Newton& newton, Observed& out);
  void see_contacts(const StepTaken& step, const Newton& newton, Observed& out) const;
  double largest_stretch(const Buffer<double>& x) const;
  double depth_in(const Body& body, const Buffer<double>& x) const;
  int passages(const Body& begin, const Body& end, const StepTaken& step) const;

  const Assembly& assembly_;
  std::vector<int> nodes_;        // (triangles, 3)
  std::vector<double> inverse_;   // (triangles, 4): of the matrix of the two sides at rest, by columns, 1/m
  std::vector<double> cell_;      // (vertices): side of a square of two triangles, m
  double circle_ = 0.0;           // m: radius of the largest circle around a triangle
  std::optional<double> energy_;  // at the end of the last step, J
};

}  // namespace sim_core
