"""What of a funnel is in a file: arrays by name, and texts. `save_load.py` writes and reads them."""

from dataclasses import asdict
from typing import Any

from lqrsim.results import schema
from lqrsim.results.archive import Arrays
from lqrsim.results.coordinates_file import coordinates_of
from lqrsim.results.funnel import FAMILIES, Funnel
from lqrsim.results.solution_parts import Trajectory

# Shapes in letters: T steps, n states, m controls, d states that may be off the plan, k knots.
ARRAYS = {
    "trajectory.controls": "T m", "trajectory.states": "T+1 n", "shape": "T+1 d d", "knots": "k", "levels": "k",
    "trials": "k", "successes": "k",
}  # fmt: skip
WHOLE_NUMBERS = ("knots", "trials", "successes")
TEXTS: dict[str, schema.Check] = {  # of the same names in a Funnel
    "family": schema.one_of(FAMILIES), "reasons": schema.listed(schema.text),
    "rate": schema.number(above=0.0, at_most=1.0), "confidence": schema.number(above=0.0, at_most=1.0),
    "simulated": schema.count, "policy_digest": schema.line, "goal_radius": schema.number(above=0.0),
    "disturbances": schema.listed(schema.text), "seed": schema.count, "options": schema.mapped(schema.anything),
    "versions": schema.mapped(schema.line),
}  # fmt: skip
CHOSEN: dict[str, schema.Check] = {"off_plan": schema.listed(schema.line)}


def parts(funnel: Funnel) -> tuple[Arrays, dict[str, Any]]:
    """Its arrays and its texts."""
    arrays: Arrays = {name: getattr(funnel, name) for name in ARRAYS if "." not in name}
    arrays |= {"trajectory.states": funnel.plan.states, "trajectory.controls": funnel.plan.controls}
    return arrays, {name: getattr(funnel, name) for name in TEXTS} | {
        "off_plan": funnel.states, "dt": funnel.plan.dt, "options": dict(funnel.options),
        "versions": dict(funnel.versions), "states": asdict(funnel.state_coordinates),
        "controls": asdict(funnel.control_coordinates),
    }  # fmt: skip


def funnel_of(arrays: Arrays, meta: dict[str, Any]) -> Funnel:
    """The funnel of a file. Raises InputError for parts that do not fit together."""
    found: dict[str, Any] = {name: arrays[name] for name in ARRAYS if "." not in name}
    found |= {name: tuple(meta[name]) if isinstance(meta[name], list) else meta[name] for name in TEXTS}
    return Funnel(
        plan=Trajectory(arrays["trajectory.states"], arrays["trajectory.controls"], float(meta["dt"])),
        state_coordinates=coordinates_of(meta["states"]),
        control_coordinates=coordinates_of(meta["controls"]),
        states=tuple(meta["off_plan"]),
        **found,
    )
