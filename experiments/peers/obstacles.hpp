// The obstacle cost of lqrsim, the same function, with derivatives by hand; its Hessian is projected to the nearest
// positive-semidefinite matrix, too.
#pragma once

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <vector>

#include "robots.hpp"

namespace {

// As lqrsim's World.table has them, a row each.
struct Obstacle {
  double kind, position[3], rotation[9], size[3];
};
enum Kind { PLANE, SPHERE, CAPSULE, CYLINDER, BOX };

// Infinite cylinders and planes, which are many, apart from the others.
struct Bar {
  double point[3], axis[3], radius;
};
struct Plane {
  double point[3], normal[3];
};
struct World {
  double radius, sharpness, weight;  // of the obstacle cost; the radius is the robot's
  std::vector<Bar> bars;
  std::vector<Plane> planes;
  std::vector<Obstacle> others;

  void fill(int count, const Obstacle* rows) {
    for (int i = 0; i < count; i++) {
      const Obstacle& o = rows[i];
      const double *p = o.position, axis[3] = {o.rotation[2], o.rotation[5], o.rotation[8]};
      if (o.kind == PLANE)
        planes.push_back({{p[0], p[1], p[2]}, {axis[0], axis[1], axis[2]}});
      else if (o.kind == CYLINDER && std::isinf(o.size[1]))
        bars.push_back({{p[0], p[1], p[2]}, {axis[0], axis[1], axis[2]}, o.size[0]});
      else
        others.push_back(o);
    }
  }
};

// Signed distance of a place in the obstacle's own axes, and its derivatives there. Where a distance is the length of a
// vector v, its Hessian is that of the directions in which the obstacle is round, over the length.
double distance(const Obstacle& o, const Vector3& place, Vector3& gradient, Matrix3& hessian) {
  const double half = o.size[1], along = place[2];
  const Vector3 up = Vector3::UnitZ(), sign = (place.array() > 0).select(Vector3::Ones(), -Vector3::Ones());
  hessian.setZero();
  if (o.kind == SPHERE || o.kind == CAPSULE) {
    const bool flat = o.kind == CAPSULE && std::abs(along) < half;
    Vector3 v = place;
    if (o.kind == CAPSULE) v[2] -= std::min(std::max(along, -half), half);
    const double length = v.norm(), inverse = length < 1e-12 ? 0 : 1 / length;
    gradient = inverse * v;
    hessian = inverse * (Vector3(1, 1, flat ? 0 : 1).asDiagonal().toDenseMatrix() - gradient * gradient.transpose());
    return length - o.size[0];
  }
  if (o.kind == CYLINDER) {
    const double radial = std::hypot(place[0], place[1]), inverse = radial < 1e-12 ? 0 : 1 / radial;
    const double side = radial - o.size[0], end = std::abs(along) - half;
    const Vector3 out(inverse * place[0], inverse * place[1], 0), around(-out[1], out[0], 0);
    if (side > 0 && end > 0) {
      const double length = std::hypot(side, end);
      gradient = (side * out + end * sign[2] * up) / length;
      hessian = (out * out.transpose() + up * up.transpose() - gradient * gradient.transpose() +
                 side * inverse * around * around.transpose()) /
                length;
      return length;
    }
    if (end > side) {
      gradient = sign[2] * up;
      return end;
    }
    gradient = out;
    hessian = inverse * around * around.transpose();
    return side;
  }
  Vector3 beyond = place.cwiseAbs() - Vector3(o.size);
  int face;
  const double deepest = beyond.maxCoeff(&face);
  if (!(deepest > 0)) {
    gradient = sign[face] * Vector3::Unit(face);
    return deepest;
  }
  beyond = beyond.cwiseMax(0);
  const double length = beyond.norm();
  gradient = sign.cwiseProduct(beyond) / length;
  for (int k = 0; k < 3; k++) hessian(k, k) = beyond[k] > 0;
  hessian = (hessian - gradient * gradient.transpose()) / length;
  return length;
}

// The cost of the obstacles that are neither; adds to the derivatives, where there are any. Not inlined, which would
// slow down the worlds without.
__attribute__((noinline)) double others(const World& world, const Vector3& place, Vector3* gradient,
                                        Matrix3* hessian) {
  double total = 0;
  for (const Obstacle& other : world.others) {
    const Matrix3 axes = Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(other.rotation);
    Vector3 slope;
    Matrix3 curve;
    const double away = distance(other, axes.transpose() * (place - Vector3(other.position)), slope, curve);
    const double cost = world.weight * std::exp(-world.sharpness * (away - world.radius));
    total += cost;
    if (gradient) {
      *gradient -= world.sharpness * cost * axes * slope;
      curve = world.sharpness * slope * slope.transpose() - curve;
      *hessian += world.sharpness * cost * axes * curve * axes.transpose();
    }
  }
  return total;
}

// The cost of the obstacles at a place; with `gradient`, its derivatives too.
double obstacles(const World& world, const Vector3& place, Vector3* gradient, Matrix3* hessian) {
  double total = 0;
  if (gradient) {
    gradient->setZero();
    hessian->setZero();
  }
  for (const Bar& bar : world.bars) {
    const Vector3 axis(bar.axis);
    Vector3 away = place - Vector3(bar.point);
    away -= axis * axis.dot(away);
    const double distance = away.norm();
    const double cost = world.weight * std::exp(-world.sharpness * (distance - bar.radius - world.radius));
    total += cost;
    if (gradient && distance > 1e-12) {
      const double slope = -world.sharpness * cost / distance;
      *gradient += slope * away;
      *hessian +=
          (world.sharpness * world.sharpness * cost - slope) / (distance * distance) * away * away.transpose() +
          slope * (Matrix3::Identity() - axis * axis.transpose());
    }
  }
  for (const Plane& plane : world.planes) {
    const Vector3 normal(plane.normal);
    const double distance = normal.dot(place - Vector3(plane.point));
    const double cost = world.weight * std::exp(-world.sharpness * (distance - world.radius));
    total += cost;
    if (gradient) {
      *gradient -= world.sharpness * cost * normal;
      *hessian += world.sharpness * world.sharpness * cost * normal * normal.transpose();
    }
  }
  if (!world.others.empty()) total += others(world, place, gradient, hessian);
  return total;
}

template <int D>
void project(Eigen::Matrix<double, D, D>& h) {
  const double minor = h(0, 0) * h(1, 1) - h(0, 1) * h(1, 0);
  if (h(0, 0) > 0 && minor > 0 && (D == 2 || h.determinant() > 0)) return;
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, D, D>> eigen(h);
  h = eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0).asDiagonal() * eigen.eigenvectors().transpose();
}

}  // namespace
