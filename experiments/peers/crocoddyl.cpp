// The problems of lqrsim's two robots as action models of Crocoddyl, and its FDDP and box-FDDP with the paper's stop test.
// Built and called by fddp.py.
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "crocoddyl/core/optctrl/shooting.hpp"
#include "crocoddyl/core/solvers/box-fddp.hpp"
#include "crocoddyl/core/solvers/fddp.hpp"
#include "crocoddyl/core/states/euclidean.hpp"
#include "obstacles.hpp"
#include "robots.hpp"

namespace {

using ConstVector = Eigen::Ref<const Eigen::VectorXd>;

// As fddp.py fills them, in this order; the weights are diagonals.
template <class Robot>
struct Numbers {
  double dt, radius, sharpness, obstacle_weight;
  Robot robot;
  double control_weight[Robot::M], control_about[Robot::M], final_weight[Robot::N], final_about[Robot::N];
  double lowest[Robot::M], highest[Robot::M];  // of the controls, for box-FDDP
};

// A step of the plan; the last one has the final cost alone, and the first no obstacle cost.
template <class Robot>
class Action : public crocoddyl::ActionModelAbstract {
 public:
  static constexpr int N = Robot::N, M = Robot::M, D = Robot::D;
  using State = typename Robot::State;
  using Control = typename Robot::Control;
  using Data = std::shared_ptr<crocoddyl::ActionDataAbstract>;

  Action(std::shared_ptr<crocoddyl::StateAbstract> state, const Numbers<Robot>& numbers, const World& world, bool first)
      : crocoddyl::ActionModelAbstract(state, M), numbers_(numbers), world_(world), first_(first) {
    // Copies, and infinite where there is no limit; FDDP does not look at them.
    set_u_lb(Eigen::Map<const Control>(numbers.lowest));
    set_u_ub(Eigen::Map<const Control>(numbers.highest));
  }

  // Crocoddyl can ask a model for itself in another precision; nothing here does.
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsDouble() const override { return nullptr; }
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsFloat() const override { return nullptr; }

  void calc(const Data& data, const ConstVector& x, const ConstVector& u) override {
    const State from = x;
    const Control control = u;
    State to;
    step(numbers_.robot, numbers_.dt, from, control, to);
    data->xnext = to;
    const Control off = control - Eigen::Map<const Control>(numbers_.control_about);
    data->cost = 0.5 * off.cwiseAbs2().dot(Eigen::Map<const Control>(numbers_.control_weight));
    if (!first_) data->cost += obstacles(world_, place(from), nullptr, nullptr);
  }

  void calc(const Data& data, const ConstVector& x) override {
    const State off = x - Eigen::Map<const State>(numbers_.final_about);
    data->cost = 0.5 * off.cwiseAbs2().dot(Eigen::Map<const State>(numbers_.final_weight));
  }

  void calcDiff(const Data& data, const ConstVector& x, const ConstVector& u) override {
    typename Robot::Slope slope;
    step_slope<Robot>(numbers_.robot, numbers_.dt, x, u, slope);
    data->Fx = slope.template leftCols<N>();
    data->Fu = slope.template rightCols<M>();
    const Eigen::Map<const Control> weight(numbers_.control_weight);
    data->Lu = weight.cwiseProduct(u - Eigen::Map<const Control>(numbers_.control_about));
    data->Luu.diagonal() = weight;  // what is not written here is zero from the start
    if (first_) return;
    Vector3 gradient;
    Matrix3 hessian;
    obstacles(world_, place(x), &gradient, &hessian);
    Eigen::Matrix<double, D, D> seen = hessian.topLeftCorner<D, D>();
    project(seen);
    data->Lx.template head<D>() = gradient.head<D>();
    data->Lxx.template topLeftCorner<D, D>() = seen;
  }

  void calcDiff(const Data& data, const ConstVector& x) override {
    const Eigen::Map<const State> weight(numbers_.final_weight);
    data->Lx = weight.cwiseProduct(x - Eigen::Map<const State>(numbers_.final_about));
    data->Lxx.diagonal() = weight;
  }

 private:
  static Vector3 place(const State& x) {
    Vector3 out = Vector3::Zero();
    out.head<D>() = x.template head<D>();
    return out;
  }

  const Numbers<Robot>& numbers_;
  const World& world_;
  bool first_;
};

// FDDP that stops when an accepted step from one feasible trajectory to another changes the cost by less than th_stop,
// relative to the cost. `Base` is SolverFDDP, or SolverBoxFDDP, which keeps the limits of the controls.
template <class Base>
class Solver : public Base {
 public:
  // `before` is the cost of the last iterate.
  Solver(std::shared_ptr<crocoddyl::ShootingProblem> problem, double& before) : Base(problem), before_(before) {}

  double stoppingCriteria() override {
    const bool accepted = this->cost_ != before_;
    this->stop_ = accepted && this->was_feasible_ && this->is_feasible_ ? std::abs((before_ - this->cost_) / this->cost_)
                                                                        : std::numeric_limits<double>::infinity();
    before_ = this->cost_;
    return this->stop_;
  }

 private:
  double& before_;
};

struct Workspace {
  World world;
  double* goal;  // where the models read it
  std::shared_ptr<crocoddyl::ShootingProblem> problem;
  double before;  // the solver's
  std::unique_ptr<crocoddyl::SolverAbstract> solver;
  std::vector<Eigen::VectorXd> states, controls;

  virtual ~Workspace() = default;
};

template <class Robot>
struct WorkspaceOf : Workspace {
  Numbers<Robot> numbers;

  WorkspaceOf(bool box, int steps, const double* given, int count, const Obstacle* rows)
      : numbers(*reinterpret_cast<const Numbers<Robot>*>(given)) {
    world.radius = numbers.radius;
    world.sharpness = numbers.sharpness;
    world.weight = numbers.obstacle_weight;
    world.fill(count, rows);
    goal = numbers.final_about;
    auto state = std::make_shared<crocoddyl::StateVector>(Robot::N);
    std::vector<std::shared_ptr<crocoddyl::ActionModelAbstract>> actions;
    for (int t = 0; t < steps; t++) actions.push_back(std::make_shared<Action<Robot>>(state, numbers, world, t == 0));
    auto last = std::make_shared<Action<Robot>>(state, numbers, world, false);
    problem = std::make_shared<crocoddyl::ShootingProblem>(Eigen::VectorXd::Zero(Robot::N), actions, last);
    problem->set_nthreads(1);
    if (box)
      solver = std::make_unique<Solver<crocoddyl::SolverBoxFDDP>>(problem, before);
    else
      solver = std::make_unique<Solver<crocoddyl::SolverFDDP>>(problem, before);
    states.assign(steps + 1, Eigen::VectorXd::Zero(Robot::N));
    controls.assign(steps, Eigen::VectorXd::Zero(Robot::M));
  }
};

template <class Matrix>
double* write(const Matrix& from, double* to) {  // row by row
  for (int i = 0; i < from.rows(); i++)
    for (int j = 0; j < from.cols(); j++) *to++ = from(i, j);
  return to;
}

}  // namespace

extern "C" {

// Everything that does not change from query to query: `numbers` as Numbers has them, and obstacles row by row.
// With `box` the solver keeps the limits of the controls.
void* make(int quadrotor, int box, int steps, const double* numbers, int count, const double* obstacles) {
  const auto* rows = reinterpret_cast<const Obstacle*>(obstacles);
  if (quadrotor) return static_cast<Workspace*>(new WorkspaceOf<Quadrotor>(box != 0, steps, numbers, count, rows));
  return static_cast<Workspace*>(new WorkspaceOf<DifferentialDrive>(box != 0, steps, numbers, count, rows));
}

void release(void* workspace) { delete static_cast<Workspace*>(workspace); }

// Solve from the guess in `states` (T+1, n) and `controls` (T, m), which the solution replaces. With `rolled_out` the
// states of the guess are those that its controls lead to. `cost` is Crocoddyl's; returns its iterations, negative
// where it did not converge.
int solve(void* workspace, const double* goal, double* states, double* controls, int rolled_out, double tolerance,
          int max_iterations, double* cost) {
  auto& work = *static_cast<Workspace*>(workspace);
  const long n = work.states[0].size(), m = work.controls[0].size(), steps = work.controls.size();
  std::copy(goal, goal + n, work.goal);
  for (long t = 0; t <= steps; t++) work.states[t] = Eigen::Map<const Eigen::VectorXd>(states + n * t, n);
  for (long t = 0; t < steps; t++) work.controls[t] = Eigen::Map<const Eigen::VectorXd>(controls + m * t, m);
  work.problem->set_x0(work.states[0]);
  work.before = std::numeric_limits<double>::quiet_NaN();
  if (rolled_out) {
    work.problem->rollout(work.controls, work.states);
    work.before = work.problem->calc(work.states, work.controls);
  }
  work.solver->set_th_stop(tolerance);
  const bool converged = work.solver->solve(work.states, work.controls, max_iterations, rolled_out != 0);
  for (long t = 0; t <= steps; t++) Eigen::Map<Eigen::VectorXd>(states + n * t, n) = work.solver->get_xs()[t];
  for (long t = 0; t < steps; t++) Eigen::Map<Eigen::VectorXd>(controls + m * t, m) = work.solver->get_us()[t];
  *cost = work.solver->get_cost();
  const int iterations = static_cast<int>(work.solver->get_iter()) + 1;
  return converged ? iterations : -iterations;
}

// For tests: what Crocoddyl is told at step t (the last is T - 1) about x (n,) and u (m,). Writes the cost, the next
// state, Fx, Fu, Lx, Lu, Lxx and Luu, one after the other.
void look(void* workspace, int t, const double* x, const double* u, double* out) {
  auto& work = *static_cast<Workspace*>(workspace);
  const auto& model = work.problem->get_runningModels()[t];
  const auto data = model->createData();
  const Eigen::VectorXd state = Eigen::Map<const Eigen::VectorXd>(x, work.states[0].size());
  const Eigen::VectorXd control = Eigen::Map<const Eigen::VectorXd>(u, work.controls[0].size());
  model->calc(data, state, control);
  model->calcDiff(data, state, control);
  *out++ = data->cost;
  out = write(data->xnext, out);
  out = write(data->Fx, out);
  out = write(data->Fu, out);
  out = write(data->Lx, out);
  out = write(data->Lu, out);
  out = write(data->Lxx, out);
  write(data->Luu, out);
}
}
