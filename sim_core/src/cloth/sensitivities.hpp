// Sensitivities of a run: derivatives of positions and velocities by parameters, through implicit
// steps and exact Coulomb friction.
//
// A step ends where R(x; x0, v0, p) = M (rate (x - target) + c (x - origin)/span) + grad E, with
// the inertia of each node's scheme (inertia.hpp), meets the law of each contact. With the branches
// of the law fixed (open, stick, slip) that is smooth, and its derivative by a parameter p is
// linear in dx/dp. With d = dx/dp, d0 = dx0/dp, the normal n of a contact, its slip u and the
// direction t of its friction, a node that a step left
//
//     open    has  dR = 0
//     stuck   has  n . d = 0,  du = 0
//     sliding has  n . d = 0,  and in the tangent plane
//                  P (dR - R_N dn) - (mu dR_N + dmu R_N) t + mu R_N/|u| (du - (t . du) t) = 0
//
// where P = 1 - n n^T, R_N = R . n, and dn is the turn of the normal by d. The law of pairs of
// closest points is the same with their force in place of R. The lengths of steps, the branches of
// contacts, what bodies force out of themselves, and what friction adds that turns within a step
// (friction_turns.hpp) are taken for constants.
//
// The linear problem is that of Newton's method with another right-hand side. Its matrix is of
// single precision and not exact, so the equations above are refined in double precision until
// another round would hardly change d [Wilkinson 1963, ch. 3]. Parameters are solved for together,
// and each solve uses the directions of those before it in the step (kernels/recycling.hpp).
#pragma once

#include <array>
#include <memory>
#include <vector>

#include "cloth/acceleration.hpp"
#include "cloth/newton.hpp"
#include "cloth/velocities.hpp"

namespace sim_core {

// A number of the cloth that a parameter changes, and by how much a unit of the parameter does.
struct SensitivityTerm {
  enum class Kind : int {
    friction_of_body = 0,  // coefficient of body `first` with sheet `second` (-1: all sheets)
    friction_of_pair = 1,  // coefficient of sheets, or of a sheet and a surface, `first` < `second`
    bending = 2,           // logarithm of a factor of the rigidity of sheet `first` (-1: all)
    stretching = 3,        // logarithm of a factor of the stiffness, likewise
    density = 4,           // logarithm of a factor of the density, likewise
    // The static coefficients of the first two, where they differ from the kinetic ones, which the
    // first two are then. Only what holds depends on them: no position does until it slips.
    static_friction_of_body = 5,
    static_friction_of_pair = 6,
    // Logarithms of factors of sheet `first`: see BendingNumber.
    bending_warp = 7,
    bending_weft = 8,
    bending_twist = 9,
    softening = 10,
  };
  Kind kind;
  int first = -1, second = -1;
  double rate = 1.0;  // per unit of the parameter

  bool is_friction_of_body() const {
    return kind == Kind::friction_of_body || kind == Kind::static_friction_of_body;
  }
  bool is_friction_of_pair() const {
    return kind == Kind::friction_of_pair || kind == Kind::static_friction_of_pair;
  }
  // Of a part of bending; the kinds of these have the order of the numbers.
  BendingNumber bending_number() const {
    return static_cast<BendingNumber>(static_cast<int>(kind) -
                                      static_cast<int>(Kind::bending_warp));
  }
  // Whether a contact with this cone bears friction by the term.
  bool is_of(Cone cone) const {
    const bool is_static =
        kind == Kind::static_friction_of_body || kind == Kind::static_friction_of_pair;
    return is_static == (cone == Cone::resting);
  }
};

// What a run is differentiated by: all that it changes in the cloth. What it moves is in
// DriveRates.
using SensitivityParameter = std::vector<SensitivityTerm>;

// Refuses a term of a missing sheet, or of two things that do not touch. mu: of sheets and
// surfaces, -1 where they do not touch.
void refuse_unknown(const SensitivityTerm& term, const Eigen::MatrixXd& mu, int sheets);

// Derivative of the pose of a body by a parameter.
struct BodyRate {
  Eigen::Vector3d origin = Eigen::Vector3d::Zero();  // m per unit
  Eigen::Vector3d turn = Eigen::Vector3d::Zero();    // rad per unit, about the origin
};

// Derivatives of what drives the cloth at the end of a step by one parameter. Those that are empty
// are zero.
struct DriveRates {
  Points3 held;     // (held, 3), m per unit
  Points3 gravity;  // (vertices, 3), m/s^2 per unit
  std::vector<BodyRate> bodies;
};

// How well the equations of the sensitivities were solved.
struct SensitivityReport {
  long steps = 0;       // of all parameters together
  long rounds = 0;      // of refinement
  long krylov = 0;      // triangular solves
  long unrefined = 0;   // steps in which another round would change more than is allowed
  double change = 0.0;  // largest such change that is expected, over the largest derivative
};

class Sensitivities {
 public:
  Sensitivities(Assembly& assembly, Newton& newton, const ClothSettings& settings);
  Sensitivities(const Sensitivities&) = delete;

  // Begins with derivatives of zero.
  void follow(const std::vector<SensitivityParameter>& parameters);
  bool empty() const { return parameters_.empty(); }
  int count() const { return static_cast<int>(parameters_.size()); }

  // By one parameter, (nodes, 4): of positions, m per unit, and velocities, m/s per unit.
  const Buffer<double>& positions(int parameter) const { return states_[parameter].x; }
  const Buffer<double>& velocities(int parameter) const { return states_[parameter].at_end; }
  // Sets them, and restarts as Velocities does.
  void set_state(int parameter, const Buffer<double>& x, const Buffer<double>& v);
  // The smallest change of a parameter by which a contact of the last step would change its branch,
  // to first order; infinite where none would.
  double nearest_event(int parameter) const { return states_[parameter].nearest_event; }
  const SensitivityReport& report() const { return report_; }

  // The velocities before a step were made ready for it.
  void begin(const Velocities& velocities, const Inertia& inertia);

  struct Step {
    double damping;     // 1/s: on top of the fabrics' own
    double lag;         // share by which stretching lagged in the step
    double begin, end;  // shares of the step that the caller asked for
    double approach;    // share of the rest of their way that held vertices went
    const Buffer<double>&start, &x;
    const Inertia& inertia;  // as the step left it
    const std::vector<Body>&at_start, &at_end;
    const std::vector<DriveRates>& rates;  // by parameter, or empty: nothing depends on any
    const Velocities& velocities;          // as the step left them
  };
  // Takes all sensitivities to the end of a step that was taken. Leaves everything else as it was.
  void advance(const Step& step);

 private:
  // By one parameter.
  struct State {
    // As in Velocities.
    Buffer<double> x, at_end, before, continuing, x_before, v_before;
    std::vector<BodyRate> bodies;  // at the start of the step
    double nearest_event = 0.0;
  };

  // The branch of a node's contact as the step left it.
  struct NodeContact {
    int mode = contact_open;
    BodyContact on;
    bool curved = false;
    Eigen::Vector3d normal, direction, force, slip;
    Eigen::Matrix3d turn;                            // of what it touches, in the step
    Eigen::Vector3d way;                             // over what it touches, not projected, m
    double normal_force = 0.0, bearing_force = 0.0;  // N: R_N, and that of both sides
    FrictionCoefficient friction;
    double turn_stiffness = 0.0;  // N/m
  };

  // The branch of a pair that bears a force.
  struct PairContact {
    const Pair* pair;
    Eigen::Matrix3d turn;
    // Derivatives of rho by the places of the closest points.
    Eigen::Matrix<double, 3, 2> along_now, along_start;
    Eigen::Vector3d direction, way;
    double turn_stiffness = 0.0, softening = 1.0, distance = 0.0;
  };

  // What a pair has by one parameter.
  struct PairChange {
    Eigen::Vector3d change = Eigen::Vector3d::Zero();      // of the force, N per unit
    Eigen::Vector3d update = Eigen::Vector3d::Zero();      // of that, by a round
    Eigen::Vector3d right_side = Eigen::Vector3d::Zero();  // N per unit
  };

  // The linear problem of a step by one parameter.
  struct Unknown {
    Buffer<double> derivative;        // d
    Buffer<double> by_parameter;      // of R, with all positions and velocities as they are
    Buffer<double> stiffness_change;  // of the energies' gradient by d, N per unit
    Buffer<float> correction;         // what contact prescribes of the next change of d
    std::vector<PairChange> pairs;
    Acceleration acceleration;
    double nearest_event = 0.0;
    // Largest component of d, of its change by the last round, and of what the next one is expected
    // to change, m per unit.
    double size = 0.0, change = 0.0, expected = 0.0;
  };

  // How a node's normal, gap and coefficient of friction change as it moves over what it touches.
  struct ContactChange {
    Eigen::Vector3d normal = Eigen::Vector3d::Zero();
    double gap = 0.0;
    double mu = 0.0;
  };

  const DriveRates& rates_of(int parameter, const Step& step) const;
  void classify_nodes(const Step& step);
  void classify_pairs(const Step& step);
  NodeContact contact_of(int node, const Step& step) const;
  ContactChange change_of(int node, const NodeContact& contact, const Step& step,
                          const Eigen::Vector3d& motion, const Eigen::Vector3d& turn) const;
  double friction_rate(int parameter, int node, const NodeContact& contact) const;
  double mu_by_direction(int node, const NodeContact& contact, const Step& step,
                         const Eigen::Vector3d& turn) const;
  double friction_rate(int parameter, const Pair& pair) const;
  static PairMotions motions_of(const Pair& pair, const Buffer<double>& vectors);

  void solve(int first, int count, const Step& step);
  void begin_solve(int parameter, const Step& step);
  void by_parameter(int parameter, const Step& step);
  void differentiate_by(const SensitivityTerm& term, const Step& step);
  void predict(const State& state, const DriveRates& rates, const Step& step,
               Buffer<double>& derivative) const;
  void differentiate_gradients(const std::vector<int>& parameters, const Step& step);
  void differentiate_stretching(int parameter, const Step& step);
  void linearize(int parameter, int place, const Step& step);
  void linearize_pairs(int parameter);
  void linearize_node(int parameter, int place, int node, const Step& step,
                      Eigen::Vector3d force_change);
  const Factor& factor_for(const Step& step);
  void subtract_corrections(const ClothMatrix& matrix, const Unknown& unknown, int place);
  void refine(const std::vector<int>& parameters, const Step& step);
  void find_pair_updates(Unknown& unknown, int place);
  void take_update(Unknown& unknown, int place);
  void update_history(int parameter, const Step& step);
  Eigen::Vector3d origin_of(const State& state, int node, const Step& step) const;
  Eigen::Vector3d target_of(const State& state, int node, const Eigen::Vector3d& gravity,
                            const Step& step) const;

  Assembly& assembly_;
  Newton& newton_;
  ClothSettings settings_;
  std::vector<SensitivityParameter> parameters_;
  std::vector<State> states_;
  SensitivityReport report_;

  std::vector<NodeContact> nodes_;
  std::vector<PairContact> pairs_;
  PairArrays pair_arrays_;
  // Factors of Newton's method serve here, too. Where it has none for the step, a spare one keeps
  // its own as they are, so that positions have the same bits with sensitivities and without.
  std::unique_ptr<StaleFactor> spare_factor_;
  std::unique_ptr<PairFactor> spare_pair_factor_;

  std::vector<int> mode_;
  Buffer<float> normal_, direction_, coupling_, turn_stiffness_, image_;
  Buffer<float> force_, solution_;  // of `solve_group` parameters
  std::vector<Unknown> unknowns_;   // by parameter
  // Directions in which the linear problems of a step were solved.
  DirectionSpace space_{};
  Buffer<float> directions_, images_, preconditioned_;
  Buffer<double> triangle_;
  Buffer<double> by_term_, pulled_, plus_, minus_, at_, at_start_;
  const DriveRates no_rates_;
  int bodies_ = 0;     // in the step at hand
  bool lags_ = false;  // whether stretching does in the step at hand
};

}  // namespace sim_core
