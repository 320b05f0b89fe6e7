// Problems of formulas as action models of Crocoddyl, and its box-FDDP. Built and called by box_fddp.py.
// The functions are those of `generated.c`, which CasADi writes: calc_* give the next state and the cost, slopes_* their
// derivatives, all dense and column by column. _begin is of the first step, which no obstacle acts at, _end of the last
// knot.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "crocoddyl/core/optctrl/shooting.hpp"
#include "crocoddyl/core/solvers/box-fddp.hpp"
#include "crocoddyl/core/states/euclidean.hpp"
#include "generated.c"

namespace {

using Vector = Eigen::VectorXd;
using Matrix = Eigen::MatrixXd;
using ConstVector = Eigen::Ref<const Vector>;
using Data = std::shared_ptr<crocoddyl::ActionDataAbstract>;
using Function = int (*)(const double**, double**, casadi_int*, double*, int);

// The nearest positive-semidefinite matrix, as lqrsim has it.
Matrix projected(const Matrix& hessian) {
  const Eigen::SelfAdjointEigenSolver<Matrix> parts(hessian);
  if (parts.eigenvalues().minCoeff() >= 0) return hessian;
  return parts.eigenvectors() * parts.eigenvalues().cwiseMax(0).asDiagonal() * parts.eigenvectors().transpose();
}

class Action : public crocoddyl::ActionModelAbstract {
 public:
  Action(std::shared_ptr<crocoddyl::StateAbstract> state, long controls, const Vector& parameters, bool begin)
      : crocoddyl::ActionModelAbstract(state, controls),
        parameters_(parameters),
        begin_(begin),
        n_(state->get_nx()),
        m_(controls),
        hessian_(n_ + m_, n_ + m_),
        gradient_(n_ + m_),
        integers_(SCRATCH_INTEGERS),
        numbers_(SCRATCH_NUMBERS) {}

  // Crocoddyl can ask a model for itself in another precision; nothing here does.
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsDouble() const override { return nullptr; }
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsFloat() const override { return nullptr; }

  void calc(const Data& data, const ConstVector& x, const ConstVector& u) override {
    call(begin_ ? calc_begin : calc_between, x, &u, {data->xnext.data(), &data->cost});
  }

  void calc(const Data& data, const ConstVector& x) override { call(calc_end, x, nullptr, {&data->cost}); }

  void calcDiff(const Data& data, const ConstVector& x, const ConstVector& u) override {
    call(begin_ ? slopes_begin : slopes_between, x, &u,
         {data->Fx.data(), data->Fu.data(), gradient_.data(), hessian_.data()});
    const Matrix convex = projected(hessian_);
    data->Lx = gradient_.head(n_);
    data->Lu = gradient_.tail(m_);
    data->Lxx = convex.topLeftCorner(n_, n_);
    data->Lxu = convex.topRightCorner(n_, m_);
    data->Luu = convex.bottomRightCorner(m_, m_);
  }

  void calcDiff(const Data& data, const ConstVector& x) override {
    Matrix hessian(n_, n_);
    call(slopes_end, x, nullptr, {data->Lx.data(), hessian.data()});
    data->Lxx = projected(hessian);
  }

 private:
  // CasADi's scratch memory holds arguments and results, too.
  void call(Function function, const ConstVector& x, const ConstVector* u, const std::vector<double*>& results) {
    const Vector state = x;
    const Vector control = u ? Vector(*u) : Vector();
    const double* arguments[SCRATCH_POINTERS] = {state.data()};
    double* answers[SCRATCH_POINTERS] = {};
    int next = 1;
    if (u) arguments[next++] = control.data();
    arguments[next] = parameters_.data();
    std::copy(results.begin(), results.end(), answers);
    function(arguments, answers, integers_.data(), numbers_.data(), 0);
  }

  const Vector& parameters_;
  bool begin_;
  long n_, m_;
  Matrix hessian_;
  Vector gradient_;
  std::vector<casadi_int> integers_;
  std::vector<double> numbers_;
};

// Box-FDDP whose own stop test, the decrease of the cost that is expected, is relative to the cost.
class Solver : public crocoddyl::SolverBoxFDDP {
 public:
  using SolverBoxFDDP::SolverBoxFDDP;

  double stoppingCriteria() override {
    this->stop_ = SolverBoxFDDP::stoppingCriteria() / std::abs(this->cost_);
    return this->stop_;
  }
};

// Notes of each iteration: when it ended, the cost, and 1 if the states and controls belong together, else 0.
class Watch : public crocoddyl::CallbackAbstract {
 public:
  explicit Watch(double* rows) : rows_(rows), begun_(std::chrono::steady_clock::now()) {}

  void operator()(crocoddyl::SolverAbstract& solver) override {
    *rows_++ = std::chrono::duration<double>(std::chrono::steady_clock::now() - begun_).count();
    *rows_++ = solver.get_cost();
    *rows_++ = solver.get_is_feasible() ? 1.0 : 0.0;
    count++;
  }

  int count = 0;

 private:
  double* rows_;
  std::chrono::steady_clock::time_point begun_;
};

}  // namespace

extern "C" {

// Solve from the states (T+1, n) and controls (T, m), which the solution replaces. `log` has room for three numbers an
// iteration. Returns the number of iterations, negative where it did not converge.
int solve(int n, int m, int steps, const double* parameters, int count, const double* low, const double* high,
          double* states, double* controls, double tolerance, int max_iterations, double* cost, double* log) {
  const Vector numbers = Eigen::Map<const Vector>(parameters, count);
  auto state = std::make_shared<crocoddyl::StateVector>(n);
  std::vector<std::shared_ptr<crocoddyl::ActionModelAbstract>> actions;
  for (int t = 0; t <= steps; t++) {
    actions.push_back(std::make_shared<Action>(state, m, numbers, t == 0));
    actions.back()->set_u_lb(Eigen::Map<const Vector>(low, m));
    actions.back()->set_u_ub(Eigen::Map<const Vector>(high, m));
  }
  const auto last = actions.back();
  actions.pop_back();
  auto problem = std::make_shared<crocoddyl::ShootingProblem>(Eigen::Map<const Vector>(states, n), actions, last);
  problem->set_nthreads(1);
  std::vector<Vector> xs, us;
  for (int t = 0; t <= steps; t++) xs.push_back(Eigen::Map<const Vector>(states + n * t, n));
  for (int t = 0; t < steps; t++) us.push_back(Eigen::Map<const Vector>(controls + m * t, m));
  Solver solver(problem);
  solver.set_th_stop(tolerance);
  auto watch = std::make_shared<Watch>(log);
  solver.setCallbacks({watch});
  const bool converged = solver.solve(xs, us, max_iterations, false);
  for (int t = 0; t <= steps; t++) Eigen::Map<Vector>(states + n * t, n) = solver.get_xs()[t];
  for (int t = 0; t < steps; t++) Eigen::Map<Vector>(controls + m * t, m) = solver.get_us()[t];
  *cost = solver.get_cost();
  return converged ? watch->count : -watch->count;
}
}
