// Inertia of the nodes in a step: M rate (x1 - target) = forces but gravity, by the scheme of each
// node.
#pragma once

#include <algorithm>
#include <vector>

#include "math/buffer.hpp"

namespace sim_core {

// How a node takes a step of dt from x0; velocities.hpp has the formulas.
//
//   staggered     velocities belong to the middles of steps
//   second_order  backward differences over two steps
//   euler         implicit Euler, for a node of second order that meets something in the step
enum class Scheme : char { staggered, second_order, euler };

struct Inertia {
  explicit Inertia(int nodes)
      : target(4L * nodes, 0.0),
        origin(target),
        guess(target),
        other_guess(target),
        euler_target(target),
        start(target),
        rate(nodes, 0.0),
        span(nodes, 1.0),
        scheme(nodes, Scheme::staggered) {}

  Buffer<double> target;        // (nodes, 4): where inertia and gravity alone lead, m
  Buffer<double> origin;        // (nodes, 4): the velocity is (x1 - origin)/span, m
  Buffer<double> guess;         // (nodes, 4): where the step is taken to end, m
  Buffer<double> other_guess;   // (nodes, 4): the same in the other way, of second order, m
  Buffer<double> euler_target;  // (nodes, 4): of nodes of second order that leave it, m
  Buffer<double> start;         // (nodes, 4): positions at the start of the step, m
  std::vector<double> rate;     // (nodes), 1/s^2
  std::vector<double> span;     // (nodes), s
  std::vector<Scheme> scheme;   // (nodes)
  double dt = 0.0;              // s
  double factor_step = 0.0;     // s: names the factor that serves, whatever the step before was

  bool has_second_order() const {
    return std::find(scheme.begin(), scheme.end(), Scheme::second_order) != scheme.end();
  }

  // Takes a node of second order to Euler's scheme. Returns whether it was one.
  bool fall_back(int node) {
    if (scheme[node] != Scheme::second_order) return false;
    scheme[node] = Scheme::euler;
    at_node(target, node) = at_node(euler_target, node);
    at_node(origin, node) = at_node(start, node);
    rate[node] = 1.0 / (dt * dt);
    span[node] = dt;
    return true;
  }
};

}  // namespace sim_core
