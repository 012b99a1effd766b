// The way of holders, surfaces and bodies between the ends of steps.
//
// A step takes them to move evenly: on straight lines, and at an even turn. What else they do in it is lost on the
// cloth. So they are looked at once in each of equal parts of an interval, near its middle: a jump in a part is seen
// there with 0.4 of its length or more. The instants are scattered by the golden ratio, so that no frequency hides.
#pragma once

#include <functional>
#include <vector>

#include "cloth/stepping.hpp"

namespace sim_core {

// Where what drives the cloth is at T times.
struct Track {
  Points3 points;                                                   // (T x (held + others), 3), m
  Eigen::Matrix<double, Eigen::Dynamic, 4, Eigen::RowMajor> poses;  // (T x bodies x 3, 4): from a body's axes, m
};
using Path = std::function<Track(const std::vector<double>& times)>;

class Course {
 public:
  // Looks at `looks` times between `begin` and `end`, s.
  void look(double begin, double end, int looks, const Path& path);
  // Largest distance from an even motion in a step from the state of the stepper to `drive`, m, at the times between
  // its begin and its end, s: of held points, surfaces, and of the bodies' material points that may be near the cloth.
  double off(double begin, double end, const Stepper& stepper, const Drive& drive) const;

 private:
  std::vector<double> times_;
  Track track_;
};

}  // namespace sim_core
