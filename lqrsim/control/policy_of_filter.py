"""A filter and its law as the recursions of an `OutputFeedbackPolicy`: all of it linear about the plan.

What is late becomes part of the state: the commands under way are numbers that move up by one place in each period.
With measurements that are late by k periods the filter lives k periods ago, and the law is of where the commands since
lead from there, which is linear in both.
"""

import numpy as np

from lqrsim.codegen.compiled_module import in_c_order
from lqrsim.control.filter_law import FilterLaw
from lqrsim.errors import Array
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.output_feedback import OutputFeedbackPolicy


def policy_of(law: FilterLaw) -> OutputFeedbackPolicy:
    """The recursions of a law."""
    model, plan = law.model, law.model.plan
    late, steps, m = model.uncertainty, plan.steps, model.m
    latency, delay = late.latency, late.delay
    size, width = model.size, model.size + (latency + delay) * m
    F, G, nominal = model.F, model.G, law.nominal
    f = nominal[1:] + model.c - np.einsum("tij,tj->ti", F, nominal[:-1]) - np.einsum("tij,tj->ti", G, plan.controls)
    arrays = {
        "gain": np.zeros((steps, m, width)), "offset": np.zeros((steps, m)),
        "correction": np.zeros((steps, width, model.sensor.size)),
        "sensor": np.empty((steps, model.sensor.size, model.n)), "sensor_offset": np.empty((steps, model.sensor.size)),
        "transition": np.zeros((steps, width, width)), "input": np.zeros((steps, width, m)),
        "drift": np.zeros((steps, width)), "nominal": np.empty((steps, width)),
    }  # fmt: skip
    measured = _expected(law)
    for t in range(steps):
        knot = max(t - latency, 0)  # that z is of
        under_way = min(t, latency) + delay  # commands, of which the newest are last
        first = width - under_way * m
        arrays["sensor"][t], arrays["sensor_offset"][t] = model.H[knot], measured[knot]
        if t >= latency:
            arrays["correction"][t, :size] = law.filter.gain[knot]
        # Where the commands under way lead: z ahead = onto (z, commands) + constant.
        onto, constant = np.eye(size, width), np.zeros(size)
        for i in range(under_way):
            j = min(knot + i, steps - 1)
            onto, constant = F[j] @ onto, F[j] @ constant + f[j]
            onto[:, first + i * m : first + (i + 1) * m] += G[j]
        at = min(t + delay, steps - 1)
        arrays["gain"][t], arrays["offset"][t] = law.gain[at] @ onto, law.gain[at] @ constant + law.offset[at]
        arrays["nominal"][t, :size] = nominal[knot]
        places = np.clip(t + delay - np.arange((latency + delay), 0, -1), 0, steps - 1)
        arrays["nominal"][t, size:] = plan.controls[places].ravel()
        _advance({name: array[t] for name, array in arrays.items()}, (F[knot], G[knot], f[knot]), size, t >= latency)
    return OutputFeedbackPolicy(
        **arrays, dt=plan.dt, state_coordinates=law.coordinates[0], control_coordinates=law.coordinates[1],
        measured_coordinates=_measured_coordinates(law),
    )  # fmt: skip


def _advance(now: dict[str, Array], step: tuple[Array, Array, Array], size: int, moves: bool) -> None:
    """Write one period's transition, input and drift; `moves` where z goes on by a period, else it waits."""
    (F, G, f), m, late = step, now["input"].shape[1], len(now["drift"]) > size
    now["transition"][:size, :size] = np.eye(size)
    if moves:
        now["transition"][:size, :size], now["drift"][:size] = F, f
        if late:  # by the oldest command
            now["transition"][:size, size : size + m] = G
        else:
            now["input"][:size] = G
    if late:  # all commands move up, and the new one is the last
        count = len(now["drift"]) - size - m
        now["transition"][size : size + count, size + m :] = np.eye(count)
        now["input"][-m:] = np.eye(m)


def _expected(law: FilterLaw) -> Array:
    """h of y = H x + h about the plan, (T+1, Y)."""
    model, plan = law.model, law.model.plan
    values = np.empty((plan.steps + 1, model.sensor.size))
    model.compiled.measurements(len(values), in_c_order(plan.states), model.compiled_sensor, values)
    return values - np.einsum("tij,tj->ti", model.H, plan.states)


def _measured_coordinates(law: FilterLaw) -> Coordinates:
    """What the measured numbers are: where they are states, these."""
    space, names = law.coordinates[0], law.model.sensor.names
    if not set(names) <= set(space.names):
        return Coordinates(names=names, units=("",) * len(names))
    chosen = [space.names.index(name) for name in names]
    whole = [
        place
        for place, i in enumerate(chosen)
        if i in space.rotation_vectors and chosen[place : place + 3] == [i, i + 1, i + 2]
    ]
    return Coordinates(
        names=names, units=tuple(space.units[i] for i in chosen), rotation_vectors=tuple(whole),
        angles=tuple(place for place, i in enumerate(chosen) if i in space.angles),
    )  # fmt: skip
