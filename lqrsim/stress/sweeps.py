"""Sweeps by name: `scenario`, the disturbances of its own demo, or a preset; `NAME:Kind` is one kind of it."""

from collections.abc import Sequence

from lqrsim.errors import InputError, check_name
from lqrsim.scenarios.packaged import Scenario
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.disturbances.presets import PRESETS, preset


def sweep(name: str, scenario: Scenario) -> tuple[Disturbance, ...]:
    """The disturbances of a name, at strength 1. Raises InputError for an unknown one, or a kind that it has not."""
    whole, colon, kind = name.partition(":")
    disturbances = tuple(_named(whole, scenario))
    if not disturbances:
        raise InputError(f"sweep: got {name!r}, which has no disturbances, want one that has")
    if not colon:
        return disturbances
    kinds = [type(disturbance).__name__ for disturbance in disturbances]
    check_name(f"kind of sweep {whole}", kind, dict.fromkeys(kinds))
    return tuple(disturbance for disturbance in disturbances if type(disturbance).__name__ == kind)


def _named(name: str, scenario: Scenario) -> Sequence[Disturbance]:
    if name == "scenario":
        return scenario.disturbances
    check_name("sweep", name, ["scenario", *PRESETS])
    return preset(name, scenario.plant())
