"""A time-varying Kalman filter about a plan: its gains depend on no measurement, so they are made ahead of time."""

from typing import NamedTuple

import numpy as np

from lqrsim.control.plan_model import PlanModel
from lqrsim.errors import Array, InputError

TINY = 1e-12  # of the largest variance of what is measured: sensors without noise would make a singular matrix


class KalmanFilter(NamedTuple):
    """What a filter is made of.

    Attributes:
      gain: K, (T+1, Z, Y). predicted: covariance of the error of z before the measurement of each knot, (T+1, Z, Z).
      corrected: after it. innovation: covariance of what a measurement differs by from what was expected, (T+1, Y, Y).
    """

    gain: Array
    predicted: Array
    corrected: Array
    innovation: Array


def kalman_filter(model: PlanModel, known: Array | None = None) -> KalmanFilter:
    """The filter of a plan's model.

    Args:
      known: covariance (Z, Z) after the measurement of the first knot, if that is taken in already: the gain there
        is zero. By default the model's start, before it.
    """
    knots, size, measured, n = model.plan.steps + 1, model.size, model.sensor.size, model.n
    gain = np.empty((knots, size, measured))
    predicted, corrected = np.empty((knots, size, size)), np.empty((knots, size, size))
    innovation = np.empty((knots, measured, measured))
    F, H, noise, fresh = model.F, model.H, model.measurement_noise, model.process_noise
    P = model.start if known is None else known
    for t in range(knots):
        predicted[t] = P
        seen = P[:, :n] @ H[t].T  # of z with what is measured
        S = H[t] @ seen[:n] + noise[t]
        S = 0.5 * (S + S.T)
        S[np.diag_indices(measured)] += TINY * S.diagonal().max() + 1e-30
        K = np.linalg.solve(S, seen.T).T
        if t == 0 and known is not None:
            K = np.zeros_like(K)
        P = P - K @ seen.T
        P = 0.5 * (P + P.T)
        gain[t], corrected[t], innovation[t] = K, P, S
        if t + 1 < knots:
            P = F[t] @ P @ F[t].T + fresh[t]
    return KalmanFilter(gain, predicted, corrected, innovation)


def check_observable(who: str, model: PlanModel) -> None:
    """Raise InputError for an unknown that changes nothing of what is measured, by name."""
    first = model.n + model.lagging
    effect, seen = np.eye(model.size)[:, first:], np.zeros(model.size - first)
    for t in range(model.plan.steps + 1):
        seen = np.maximum(seen, np.abs(model.H[t] @ effect[: model.n]).max(axis=0, initial=0.0))
        if t < model.plan.steps:
            effect = model.F[t] @ effect
    for unknown, own in zip(model.remembered, model.own_states, strict=True):
        if (unknown.std or unknown.drift) and not seen[own].max() > 0:
            measured = ", ".join(model.sensor.names)
            raise InputError(
                f"{who}: unknowns: got {unknown.name}, which changes nothing of what is measured ({measured}),"
                " want sensors that see its effect"
            )
