// The quadrotor problem of lqrsim.scenarios as an action model of Crocoddyl, and its FDDP with the paper's stop test.
// Built and called by peers.py.
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "crocoddyl/core/optctrl/shooting.hpp"
#include "crocoddyl/core/solvers/fddp.hpp"
#include "crocoddyl/core/states/euclidean.hpp"
#include "solver_benchmark/quadrotor.hpp"

namespace {

using ConstVector = Eigen::Ref<const Eigen::VectorXd>;

// A step of the plan; the last one has the final cost alone, and the first no obstacle cost.
class Action : public crocoddyl::ActionModelAbstract {
 public:
  using Data = std::shared_ptr<crocoddyl::ActionDataAbstract>;

  Action(std::shared_ptr<crocoddyl::StateAbstract> state, const World& world, bool first)
      : crocoddyl::ActionModelAbstract(state, M), world_(world), first_(first) {}

  // Crocoddyl can ask a model for itself in another precision; nothing here does.
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsDouble() const override { return nullptr; }
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsFloat() const override { return nullptr; }

  void calc(const Data& data, const ConstVector& x, const ConstVector& u) override {
    const Numbers& p = world_.numbers;
    const State from = x;
    const Control control = u;
    State to;
    step(p, from, control, to);
    data->xnext = to;
    const Control off = control - Eigen::Map<const Control>(p.control_about);
    data->cost = 0.5 * off.cwiseAbs2().dot(Eigen::Map<const Control>(p.control_weight));
    if (!first_) data->cost += obstacles(world_, from.head<3>(), nullptr, nullptr);
  }

  void calc(const Data& data, const ConstVector& x) override {
    const State off = x - Eigen::Map<const State>(world_.numbers.final_about);
    data->cost = 0.5 * off.cwiseAbs2().dot(Eigen::Map<const State>(world_.numbers.final_weight));
  }

  void calcDiff(const Data& data, const ConstVector& x, const ConstVector& u) override {
    const Numbers& p = world_.numbers;
    Slope slope;
    step_slope(p, x, u, slope);
    data->Fx = slope.leftCols<N>();
    data->Fu = slope.rightCols<M>();
    const Eigen::Map<const Control> weight(p.control_weight);
    data->Lu = weight.cwiseProduct(u - Eigen::Map<const Control>(p.control_about));
    data->Luu.diagonal() = weight;  // what is not written here is zero from the start
    if (first_) return;
    Vector3 gradient;
    Matrix3 hessian;
    obstacles(world_, x.head<3>(), &gradient, &hessian);
    project(hessian);
    data->Lx.head<3>() = gradient;
    data->Lxx.topLeftCorner<3, 3>() = hessian;
  }

  void calcDiff(const Data& data, const ConstVector& x) override {
    const Eigen::Map<const State> weight(world_.numbers.final_weight);
    data->Lx = weight.cwiseProduct(x - Eigen::Map<const State>(world_.numbers.final_about));
    data->Lxx.diagonal() = weight;
  }

 private:
  const World& world_;
  bool first_;
};

// FDDP that stops when an accepted step from one feasible trajectory to another changes the cost by less than th_stop,
// relative to the cost.
class Solver : public crocoddyl::SolverFDDP {
 public:
  explicit Solver(std::shared_ptr<crocoddyl::ShootingProblem> problem) : SolverFDDP(problem) {}

  double before = std::numeric_limits<double>::quiet_NaN();  // cost of the last iterate

  double stoppingCriteria() override {
    const bool accepted = cost_ != before;
    stop_ = accepted && was_feasible_ && is_feasible_ ? std::abs((before - cost_) / cost_)
                                                      : std::numeric_limits<double>::infinity();
    before = cost_;
    return stop_;
  }
};

struct Workspace {
  World world;
  std::shared_ptr<crocoddyl::ShootingProblem> problem;
  std::unique_ptr<Solver> solver;
  std::vector<Eigen::VectorXd> states, controls;
};

}  // namespace

extern "C" {

// Everything that does not change from query to query; `numbers` is of the size of Numbers, and so on.
void* make(int steps, const double* numbers, int cylinders, const double* cylinder, int planes, const double* plane) {
  auto* made = new Workspace;
  made->world.numbers = *reinterpret_cast<const Numbers*>(numbers);
  const auto* first_cylinder = reinterpret_cast<const Cylinder*>(cylinder);
  const auto* first_plane = reinterpret_cast<const Plane*>(plane);
  made->world.cylinders.assign(first_cylinder, first_cylinder + cylinders);
  made->world.planes.assign(first_plane, first_plane + planes);
  auto state = std::make_shared<crocoddyl::StateVector>(N);
  std::vector<std::shared_ptr<crocoddyl::ActionModelAbstract>> actions;
  for (int t = 0; t < steps; t++) actions.push_back(std::make_shared<Action>(state, made->world, t == 0));
  auto last = std::make_shared<Action>(state, made->world, false);
  made->problem = std::make_shared<crocoddyl::ShootingProblem>(Eigen::VectorXd::Zero(N), actions, last);
  made->problem->set_nthreads(1);
  made->solver = std::make_unique<Solver>(made->problem);
  made->states.assign(steps + 1, Eigen::VectorXd::Zero(N));
  made->controls.assign(steps, Eigen::VectorXd::Zero(M));
  return made;
}

void release(void* workspace) { delete static_cast<Workspace*>(workspace); }

// Solve from the guess in `states` (T+1, 12) and `controls` (T, 4), which the solution replaces. With `rolled_out` the
// states of the guess are those that its controls lead to. `cost` is Crocoddyl's; returns its iterations, negative
// where it did not converge.
int solve(void* workspace, const double* goal, double* states, double* controls, int rolled_out, double tolerance,
          int max_iterations, double* cost) {
  auto& work = *static_cast<Workspace*>(workspace);
  const int steps = static_cast<int>(work.controls.size());
  std::copy(goal, goal + N, work.world.numbers.final_about);
  for (int t = 0; t <= steps; t++) work.states[t] = Eigen::Map<const State>(states + N * t);
  for (int t = 0; t < steps; t++) work.controls[t] = Eigen::Map<const Control>(controls + M * t);
  work.problem->set_x0(work.states[0]);
  work.solver->before = std::numeric_limits<double>::quiet_NaN();
  if (rolled_out) {
    work.problem->rollout(work.controls, work.states);
    work.solver->before = work.problem->calc(work.states, work.controls);
  }
  work.solver->set_th_stop(tolerance);
  const bool converged = work.solver->solve(work.states, work.controls, max_iterations, rolled_out != 0);
  for (int t = 0; t <= steps; t++) Eigen::Map<State>(states + N * t) = work.solver->get_xs()[t];
  for (int t = 0; t < steps; t++) Eigen::Map<Control>(controls + M * t) = work.solver->get_us()[t];
  *cost = work.solver->get_cost();
  const int iterations = static_cast<int>(work.solver->get_iter()) + 1;
  return converged ? iterations : -iterations;
}
}
