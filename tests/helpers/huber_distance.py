"""A cost in one file, as a user may write it: Huber's loss of a distance, quadratic near a place and linear far off."""

from dataclasses import dataclass, replace

import numpy as np

import lqrsim as ls


@dataclass(frozen=True, eq=False)
class HuberDistance(ls.Cost):
    """`weight r^2 / 2`, and beyond the width `weight width (r - width / 2)`, r the distance of states to a place."""

    place: dict[str, float]
    weight: float
    width: float

    def bind(self, dynamics: ls.Dynamics) -> ls.types.CostTerm:
        kernel = ls.types.source_of(__name__, AXES=tuple(map(dynamics.state_coordinates.names.index, self.place)))
        return ls.types.CostTerm(kernel, np.array([self.weight, self.width, *self.place.values()]))

    @property
    def state_reference(self) -> ls.QuadraticCost:  # a goal: the search has paths to it, and a viewer can move it
        return ls.QuadraticCost(dict.fromkeys(self.place, self.weight), about=self.place)

    def scaled(self, factor: float) -> "HuberDistance":
        return replace(self, weight=factor * self.weight)

    def moved_to(self, state: np.ndarray, dynamics: ls.Dynamics) -> "HuberDistance":
        there = dict(zip(dynamics.state_coordinates.names, state.tolist(), strict=True))
        return replace(self, place={name: there[name] for name in self.place})

    def with_added_state(self, dynamics: ls.Dynamics) -> "HuberDistance":
        return self


AXES, WEIGHT, WIDTH, PLACE = (0,), 0, 1, 2  # the states of the distance, and where in `data` the numbers are


def value(x, u, t, data):
    r, width = distance(x, data), data[WIDTH]
    return data[WEIGHT] * (0.5 * r * r if r <= width else width * (r - 0.5 * width))


def derivatives(x, u, t, data, hessian, gradient):
    r, width = distance(x, data), data[WIDTH]
    pull = data[WEIGHT] * width / max(r, width)
    for i in range(len(AXES)):
        gradient[AXES[i]] += pull * (x[AXES[i]] - data[PLACE + i])
        hessian[AXES[i], AXES[i]] += pull
        for j in range(len(AXES) if r > width else 0):
            hessian[AXES[i], AXES[j]] -= pull * (x[AXES[i]] - data[PLACE + i]) * (x[AXES[j]] - data[PLACE + j]) / r**2
    return value(x, u, t, data)


def distance(x, data):
    square = 0.0
    for i in range(len(AXES)):
        square += (x[AXES[i]] - data[PLACE + i]) ** 2
    return square**0.5
