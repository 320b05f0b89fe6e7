// The dynamics of lqrsim's two robots, the same functions, with derivatives by hand. The numbers are data.
#pragma once

#include <Eigen/Core>
#include <cmath>

namespace {

using Vector3 = Eigen::Vector3d;
using Matrix3 = Eigen::Matrix3d;

template <int n, int m>
struct Sizes {
  static constexpr int N = n, M = m, W = n + m;
  using State = Eigen::Matrix<double, N, 1>;
  using Control = Eigen::Matrix<double, M, 1>;
  using Slope = Eigen::Matrix<double, N, W, Eigen::RowMajor>;
};

// The robots' constants, in the order of the parameters of lqrsim's dynamics. The first D states are the position.
struct Quadrotor : Sizes<12, 4> {
  static constexpr int D = 3;
  double mass, inertia, arm, torque_ratio, drag, gravity;
  struct Rate;
};

struct DifferentialDrive : Sizes<3, 2> {
  static constexpr int D = 2;
  double axle;
  struct Rate;
};

// sin t / t, (1 - cos t) / t^2 and (1 - t/2 cot(t/2)) / t^2 for t^2 = s, and their derivatives in s.
struct Ratios {
  double a, b, c, da, db, dc;
  explicit Ratios(double s) {
    if (s < 0.04) {
      const double c4 = 1. / 47900160, c5 = 691. / 1307674368000.;
      a = 1 + s * (-1. / 6 + s * (1. / 120 + s * (-1. / 5040 + s * (1. / 362880 - s / 39916800))));
      b = .5 + s * (-1. / 24 + s * (1. / 720 + s * (-1. / 40320 + s * (1. / 3628800 - s / 479001600))));
      c = 1. / 12 + s * (1. / 720 + s * (1. / 30240 + s * (1. / 1209600 + s * (c4 + s * c5))));
      da = -1. / 6 + s * (2. / 120 + s * (-3. / 5040 + s * (4. / 362880 - s * 5 / 39916800)));
      db = -1. / 24 + s * (2. / 720 + s * (-3. / 40320 + s * (4. / 3628800 - s * 5 / 479001600)));
      dc = 1. / 720 + s * (2. / 30240 + s * (3. / 1209600 + s * (4 * c4 + s * 5 * c5)));
    } else {
      const double t = std::sqrt(s), cosine = std::cos(t);
      a = std::sin(t) / t;
      b = (1 - cosine) / s;
      c = (1 - a / (2 * b)) / s;
      da = (cosine - a) / (2 * s);
      db = (a - 2 * b) / (2 * s);
      dc = (-(da * b - a * db) / (2 * b * b) - c) / s;
    }
  }
};

Matrix3 cross(const Vector3& v) {
  Matrix3 out;
  out << 0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0;
  return out;
}

// xdot; with `slope`, also its derivatives: of the acceleration in r and the force, of the rate of r in r and w.
struct Quadrotor::Rate {
  Vector3 up;               // the body's z axis in the world
  Matrix3 force_r, r_r, r_w;  // d(acceleration)/dr, d(rdot)/dr, d(rdot)/dw

  void operator()(const Quadrotor& p, const State& x, const Control& u, State& out, bool slope) {
    const Vector3 r = x.segment<3>(6), w = x.segment<3>(9);
    const double s = r.squaredNorm(), thrust = u.sum() / p.mass, along = r.dot(w);
    const Ratios ratio(s);
    up = Vector3(ratio.a * r[1] + ratio.b * r[0] * r[2], -ratio.a * r[0] + ratio.b * r[1] * r[2],
                 1 + ratio.b * (r[2] * r[2] - s));
    const Vector3 twice = r * along - s * w;  // r x (r x w)
    out.head<3>() = x.segment<3>(3);
    out.segment<3>(3) = thrust * up - p.drag / p.mass * x.segment<3>(3);
    out[5] -= p.gravity;
    out.segment<3>(6) = w + 0.5 * r.cross(w) + ratio.c * twice;
    out[9] = p.arm / p.inertia * (u[1] - u[3]);
    out[10] = p.arm / p.inertia * (u[2] - u[0]);
    out[11] = p.torque_ratio / p.inertia * (u[0] - u[1] + u[2] - u[3]);
    if (!slope) return;
    const Vector3 in_s(ratio.da * r[1] + ratio.db * r[0] * r[2], -ratio.da * r[0] + ratio.db * r[1] * r[2],
                       ratio.db * (r[2] * r[2] - s));
    Matrix3 straight;
    straight << ratio.b * r[2], ratio.a, ratio.b * r[0], -ratio.a, ratio.b * r[2], ratio.b * r[1],
        -2 * ratio.b * r[0], -2 * ratio.b * r[1], 0;
    force_r = thrust * (straight + 2 * in_s * r.transpose());
    r_r = -0.5 * cross(w) + 2 * ratio.dc * twice * r.transpose() +
          ratio.c * (along * Matrix3::Identity() + r * w.transpose() - 2 * w * r.transpose());
    r_w = (1 - ratio.c * s) * Matrix3::Identity() + 0.5 * cross(r) + ratio.c * r * r.transpose();
  }

  // fx ([1 0] + a previous) + [0 fu], written out for the blocks that are not zero.
  void chain(const Quadrotor& p, const Slope& previous, double a, Slope& out) const {
    Slope inner = a * previous;
    for (int i = 0; i < N; i++) inner(i, i) += 1;
    out.topRows<3>() = inner.middleRows<3>(3);
    out.middleRows<3>(3).noalias() = force_r.lazyProduct(inner.middleRows<3>(6));
    out.middleRows<3>(3) -= p.drag / p.mass * inner.middleRows<3>(3);
    for (int j = 0; j < M; j++) out.block<3, 1>(3, N + j) += up / p.mass;
    out.middleRows<3>(6).noalias() = r_r.lazyProduct(inner.middleRows<3>(6));
    out.middleRows<3>(6).noalias() += r_w.lazyProduct(inner.middleRows<3>(9));
    out.bottomRows<3>().setZero();
    const double tilt = p.arm / p.inertia, turn = p.torque_ratio / p.inertia;
    out(9, N + 1) = out(10, N + 2) = tilt;
    out(9, N + 3) = out(10, N) = -tilt;
    out(11, N) = out(11, N + 2) = turn;
    out(11, N + 1) = out(11, N + 3) = -turn;
  }
};

// As above; the derivatives are those of the velocity in the heading.
struct DifferentialDrive::Rate {
  double sine, cosine, speed;

  void operator()(const DifferentialDrive& p, const State& x, const Control& u, State& out, bool) {
    sine = std::sin(x[2]);
    cosine = std::cos(x[2]);
    speed = (u[0] + u[1]) / 2;
    out << speed * cosine, speed * sine, (u[1] - u[0]) / p.axle;
  }

  void chain(const DifferentialDrive& p, const Slope& previous, double a, Slope& out) const {
    Slope inner = a * previous;
    for (int i = 0; i < N; i++) inner(i, i) += 1;
    out.row(0) = -speed * sine * inner.row(2);
    out.row(1) = speed * cosine * inner.row(2);
    out.row(2).setZero();
    for (int j = N; j < W; j++) {
      out(0, j) += cosine / 2;
      out(1, j) += sine / 2;
    }
    out(2, N) = -1 / p.axle;
    out(2, N + 1) = 1 / p.axle;
  }
};

// One Runge-Kutta step.
template <class Robot>
void step(const Robot& p, double dt, const typename Robot::State& x, const typename Robot::Control& u,
          typename Robot::State& out) {
  typename Robot::Rate rate;
  typename Robot::State k, z;
  rate(p, x, u, k, false);
  out = k;
  z = x + 0.5 * dt * k;
  rate(p, z, u, k, false);
  out += 2 * k;
  z = x + 0.5 * dt * k;
  rate(p, z, u, k, false);
  out += 2 * k;
  z = x + dt * k;
  rate(p, z, u, k, false);
  out = x + dt / 6 * (out + k);
}

// Its derivatives, of the states before those of the controls.
template <class Robot>
void step_slope(const Robot& p, double dt, const typename Robot::State& x, const typename Robot::Control& u,
                typename Robot::Slope& out) {
  typename Robot::Rate rate;
  typename Robot::State k, z;
  typename Robot::Slope zero = Robot::Slope::Zero(), first, second;
  rate(p, x, u, k, true);
  rate.chain(p, zero, 0, first);
  out = first;
  z = x + 0.5 * dt * k;
  rate(p, z, u, k, true);
  rate.chain(p, first, 0.5 * dt, second);
  out += 2 * second;
  z = x + 0.5 * dt * k;
  rate(p, z, u, k, true);
  rate.chain(p, second, 0.5 * dt, first);
  out += 2 * first;
  z = x + dt * k;
  rate(p, z, u, k, true);
  rate.chain(p, first, dt, second);
  out = dt / 6 * (out + second);
  for (int i = 0; i < Robot::N; i++) out(i, i) += 1;
}

}  // namespace
