#include "rods/rods.hpp"

#include <algorithm>
#include <cmath>
#include <sstream>
#include <stdexcept>
#include <string>

namespace sim_core {
namespace {

constexpr int start_elements_min = 24;

}  // namespace

int default_start_level(int elements) {
  int level = 0;
  while (level < 2 && (elements >> (2 - level)) < start_elements_min) ++level;
  return level;
}

void check_settings(const RodSettings& settings, int points, double curvature_max) {
  if (points < 2) throw std::invalid_argument("points: must be at least 2, got " + std::to_string(points));
  if (settings.elements < elements_min || settings.elements % 4 != 0) {
    throw std::invalid_argument("elements: must be a multiple of 4 and at least " + std::to_string(elements_min) +
                                ", got " + std::to_string(settings.elements));
  }
  if (settings.start_level < 0 || settings.start_level > 2) {
    throw std::invalid_argument("start_level: must be 0, 1 or 2, got " + std::to_string(settings.start_level));
  }
  if (curvature_max > element_turn_max * (settings.elements / 4)) {
    std::ostringstream message;
    message << "elements: must be at least 4 |natural curvature| / " << element_turn_max
            << " so that every element turns by less than half a turn, got " << settings.elements
            << " for |natural curvature| = " << curvature_max;
    throw std::invalid_argument(message.str());
  }
}

void check_rods(const RodSettings& settings, int points, const double* phi0, const double* phi1, std::int64_t n) {
  double curvature = 0.0;
  for (std::int64_t i = 0; i < n; ++i) curvature = std::max(curvature, std::hypot(phi0[i], phi1[i]));
  check_settings(settings, points, curvature);
}

std::vector<SamplePoint> sample_points(int points, int elements) {
  const int nodes = elements / 2;
  const double h = 1.0 / nodes;
  std::vector<SamplePoint> samples(points);
  for (int j = 0; j < points; ++j) {
    // Integers first: whole nodes are hit exactly.
    const std::int64_t product = static_cast<std::int64_t>(j) * nodes;
    std::int64_t node = product / (points - 1);
    if (node == nodes) node = nodes - 1;
    const double x = static_cast<double>(product - node * (points - 1)) / (points - 1), x3 = x * x * x;
    const double y = 1.0 - x, y3 = y * y * y;
    samples[j] = {static_cast<int>(node),
                  {y3 * (1.0 + x * (3.0 + 6.0 * x)), h * (y3 * x * (1.0 + 3.0 * x)), h * h * (0.5 * y3 * x * x),
                   x3 * (1.0 + y * (3.0 + 6.0 * y)), -h * (x3 * y * (1.0 + 3.0 * y)), h * h * (0.5 * x3 * y * y)}};
  }
  return samples;
}

}  // namespace sim_core
