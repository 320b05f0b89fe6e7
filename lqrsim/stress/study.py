"""What is run: the records that state studies and campaigns. Plain data, which converts to JSON and back.

A study is one policy of a scenario under disturbances; a campaign is many, with trials of each. Both state the same
`Setup`. A study becomes a plant and a controller in `Study.closed_loop`, a campaign in `trials.Trials`.
"""

import dataclasses
import inspect
import itertools
import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lqrsim.errors import (
    InputError,
    check_count,
    check_items,
    check_kind,
    check_name,
    check_number,
    check_seed,
    check_text,
    excerpt,
    keep,
    keep_positive,
)
from lqrsim.results.solution import Solution
from lqrsim.scenarios import solutions
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import disturbance_set, from_anywhere, resolve
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.stress.policies import (
    CAMPAIGN_POLICIES,
    DEFAULT_POLICIES,
    POLICIES,
    check_designed,
    design_disturbances,
    impossible_policies,
    make_policy,
)

_MOST_FILES = 1_000_000  # largest number of shards in a folder


@dataclass(frozen=True)
class Cell:
    """A combination of policy, disturbances and strength. All cells use the same random numbers.

    Attributes:
      policy: name of the policy; see `Campaign`.
      sweep: the name of the disturbances.
      strength: factor by which they are scaled, 0 or more.
    """

    policy: str
    sweep: str
    strength: float

    def __post_init__(self) -> None:
        for name in ("policy", "sweep"):
            check_text(f"Cell: {name}", getattr(self, name), "a name")
        keep(self, strength=check_number("Cell: strength", self.strength, at_least=0.0))

    def __str__(self) -> str:
        return f"{self.policy},{self.sweep},{self.strength:g}"

    @classmethod
    def named(cls, text: str, cells: Sequence["Cell"]) -> "Cell":
        """The cell of a number or of a text, policy,sweep,strength.

        Args:
          text: the number, from 0, or the three parts separated by commas.
          cells: the cells to choose from.
        """
        cells = check_items("cells", cells, Cell, "a list of Cell")
        if not cells:
            raise InputError("cells: got none, want at least one")
        check_kind("cell", text, str, f"text: a number from 0 to {len(cells) - 1}, or as {cells[0]}")
        if text.isdecimal() and len(text) < 10 and int(text) < len(cells):
            return cells[int(text)]
        for cell in cells:
            if text == str(cell):
                return cell
        raise InputError(f"cell: got {excerpt(text)}, want 0 to {len(cells) - 1}, or as {cells[0]} to {cells[-1]}")


@dataclass(frozen=True)
class Shard:
    """Consecutive trials of a cell that are run together and stored in one file."""

    cell: int
    first: int
    count: int

    def __post_init__(self) -> None:
        for name, least in (("cell", 0), ("first", 0), ("count", 1)):
            check_count(f"Shard: {name}", getattr(self, name), at_least=least)

    @property
    def file(self) -> str:
        """The name of its file: the numbers of the cell and of the first trial."""
        return f"{self.cell:04d}-{self.first:09d}.parquet"


@dataclass(frozen=True, eq=False)
class Setup:
    """What every study of a scenario states, of one policy or of many: the base of `Study` and `Campaign`.

    Attributes:
      scenario: as in `lqrsim solve`. Relative paths become absolute.
      solution: a Solution, or the path of one, to run instead of solving the scenario. A solution of `ilqr` replaces
        that of the policy "ilqr", any other those of all other policies.
      design_disturbances: the disturbances for which "track" and "offset_free" are designed, independent of the
        disturbances in a trial: of a campaign a tuple of them, of a study the name of a set. By default the preset
        "moderate": one policy serves all strengths, and this preset is in the middle.
      goal_radius: distance in metres within which the goal counts as reached; by default the scenario's.
      goal_tolerance: the tolerance for robots without a position, as a scaled error; by default the scenario's.
      seed: seed of all random numbers.
    """

    scenario: str
    _: KW_ONLY
    solution: Solution | str | os.PathLike[str] | None = None
    design_disturbances: tuple[Disturbance, ...] | str | None = None
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_text("scenario", self.scenario, "a reference, such as 'quadrotor'", at_most=10_000)
        keep(self, scenario=from_anywhere(self.scenario))  # workers and reports may run in other folders
        kinds = (Solution, str, os.PathLike, type(None))
        check_kind("solution", self.solution, kinds, "a Solution, the path of one, or None")
        keep_positive(self, "goal_radius", "goal_tolerance")
        keep(self, seed=check_seed("seed", self.seed))

    @cached_property
    def resolved(self) -> Scenario:
        """The scenario, made once: a user's function may return another each time."""
        return resolve(self.scenario)

    @cached_property
    def given(self) -> Solution | None:
        """The solution that was given instead of solving, or None. Raises InputError if the solution does not fit."""
        return None if self.solution is None else solutions.given(self.resolved, self.solution)

    @cached_property
    def goal_options(self) -> dict[str, Any]:
        """The goal options of `simulate`. Raises InputError if they do not fit the scenario."""
        self.resolved.target_radius(self.goal_radius, self.goal_tolerance)
        return self.resolved.near_enough(self.goal_radius, self.goal_tolerance)


@dataclass(frozen=True, kw_only=True, eq=False)
class Study(Setup):
    """A policy of a scenario under disturbances. The scenario is solved when first needed.

    Attributes:
      sweep: the name of a set of disturbances, as in `lqrsim stress`; by default the disturbances of the scenario's
        demo.
      strength: factor by which they are scaled.
      policy: as in `Campaign`.
    """

    design_disturbances: str | None = None
    sweep: str = "scenario"
    strength: float = 1.0
    policy: str = "smooth"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_text("sweep", self.sweep, "a name, such as 'light'")
        keep(self, strength=check_number("strength", self.strength, above=0.0))
        check_name("policy", self.policy, POLICIES)
        if self.design_disturbances is not None:
            check_designed((self.policy,))
            check_text("design_disturbances", self.design_disturbances, "a name, such as 'light'")

    @cached_property
    def disturbances(self) -> list[Disturbance]:
        """The disturbances of the set, scaled by the strength. Raises InputError if there is no such set."""
        return [one.scaled(self.strength) for one in disturbance_set(self.sweep, self.resolved)]

    @cached_property
    def closed_loop(self) -> dict[str, Any]:
        """The arguments of `funnel` and `TrialScore` but the disturbances: plant, solution, controller and goal."""
        goal, design = self.goal_options, self.design_disturbances  # checked before the scenario is solved
        # Whoever has a Solution at hand knows of which problem it is.
        remark = not isinstance(self.solution, Solution)
        solution, controller = make_policy(self.policy, self.resolved, design, self.given, remark=remark)
        plant = self.resolved.settled(solution).plant()
        return {"plant": plant, "solution": solution, "controller": controller, **goal}


@dataclass(frozen=True, kw_only=True)
class Campaign(Setup):
    """A stress test: trials of policies under disturbances of growing strength.

    Attributes:
      sweeps: name -> disturbances at strength 1.
      strengths: factors by which the disturbances are scaled; 0.5 and 2 turn light into calm and moderate.
      policies: some of CAMPAIGN_POLICIES. "smooth" and "ilqr" come from lqrsim.smooth and lqrsim.ilqr; "open_loop" is
        the plan of smooth without feedback; "replan" re-plans during the run; "track" and "offset_free" follow the plan
        of smooth, with lqrsim.track and lqrsim.OffsetFree; "track_per_cell", "offset_free_per_cell" are designed anew
        for the disturbances of each cell, which no single policy knows. By default the first four.
      trials: number of trials for each sweep, strength and policy.
      replan_every: seconds between two solves of replan; by default a tenth of the horizon.
      shard: trials per file; an interruption loses at most this many per worker.
      time_limit: seconds after which a shard counts as hung and its trials as errors.
    """

    design_disturbances: tuple[Disturbance, ...] | None = None
    sweeps: Mapping[str, tuple[Disturbance, ...]]
    strengths: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0)
    policies: tuple[str, ...] = DEFAULT_POLICIES
    trials: int = 200
    replan_every: float | None = None
    shard: int = 500
    time_limit: float = 300.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.sweeps, Mapping) or not self.sweeps:
            raise InputError(f"sweeps: got {excerpt(self.sweeps)}, want at least one: name -> disturbances")
        wanted = "a tuple of disturbances, such as (ControlNoise(0.05),)"
        for name in self.sweeps:
            check_text("sweeps: name", name, "a name without a comma")
            if "," in name:
                raise InputError(f"sweeps: got the name {excerpt(name)}, want one without a comma")
        sweeps = self.sweeps.items()
        keep(self, sweeps={name: check_items(f"sweeps: {name}", some, Disturbance, wanted) for name, some in sweeps})
        strengths = check_items("strengths", self.strengths, object, "a tuple of numbers", at_most=1000)
        keep(self, strengths=tuple(check_number("strengths", strength, at_least=0.0) for strength in strengths))
        policies = check_items(
            "policies", self.policies, object, f"a tuple of {', '.join(CAMPAIGN_POLICIES)}", at_most=100
        )
        keep(self, policies=tuple(check_name("policies", policy, CAMPAIGN_POLICIES) for policy in policies))
        for field in ("strengths", "policies"):
            values = getattr(self, field)
            if not values or len(set(values)) < len(values):
                raise InputError(f"{field}: got {excerpt(values)}, want at least one entry, each at most once")
        if self.design_disturbances is not None:
            check_designed(self.policies)
            design = check_items("design_disturbances", self.design_disturbances, Disturbance, wanted)
            if not design:
                raise InputError(
                    "design_disturbances: got none, want at least one disturbance, or None for the default"
                )
            keep(self, design_disturbances=design)
        for field in ("trials", "shard"):
            keep(self, **{field: check_count(field, getattr(self, field))})
        files = -(-self.trials // self.shard) * len(self.cells)
        if files > _MOST_FILES:
            raise InputError(
                f"trials: got {self.trials} in shards of {self.shard} for {len(self.cells)} cells, which takes {files}"
                f" files, want at most {_MOST_FILES}: fewer trials, or larger shards"
            )
        keep_positive(self, "replan_every")
        keep(self, time_limit=check_number("time_limit", self.time_limit, above=0.0))

    @classmethod
    def of_sets(cls, setup: Setup, sets: Sequence[str], *, policies: Sequence[str] = (), **options: Any) -> "Campaign":
        """A campaign whose disturbances are sets by name, as in `lqrsim stress`.

        Args:
          setup: what it shares with other studies; its design disturbances are a set, too.
          sets: names of the sweeps.
          policies: as in `Campaign`; by default those of the first four that the scenario allows.
          **options: the other attributes of `Campaign`.
        """
        scenario, design = setup.resolved, setup.design_disturbances
        impossible = impossible_policies(scenario, setup.given)
        shared = {one.name: getattr(setup, one.name) for one in dataclasses.fields(Setup)}
        named = {
            "design_disturbances": None if design is None else tuple(design_disturbances(scenario, design)),
            "sweeps": {name: disturbance_set(name, scenario) for name in sets},
            "policies": tuple(policies) or tuple(one for one in DEFAULT_POLICIES if one not in impossible),
        }
        campaign = cls(**options | shared | named)
        keep(campaign, resolved=scenario, given=setup.given)
        return campaign

    @property
    def cells(self) -> list[Cell]:
        """All combinations, in the order of their numbers."""
        combinations = itertools.product(self.sweeps, self.strengths, self.policies)
        return [Cell(policy, sweep, strength) for sweep, strength, policy in combinations]

    def disturbances(self, cell: Cell) -> list[Disturbance]:
        """The disturbances of a cell's trials.

        Args:
          cell: one of the campaign's cells.
        """
        check_kind("cell", cell, Cell, "a Cell of the campaign")
        check_name("cell: sweep", cell.sweep, self.sweeps)
        return [disturbance.scaled(cell.strength) for disturbance in self.sweeps[cell.sweep]]

    def as_json(self) -> dict[str, Any]:
        """The campaign as plain data without its solution, from which `from_json` makes it again."""
        design = self.design_disturbances
        fields = {name: getattr(self, name) for name in CAMPAIGN_FIELDS} | {
            "sweeps": {name: disturbances_as_json(disturbances) for name, disturbances in self.sweeps.items()},
            "design_disturbances": None if design is None else disturbances_as_json(design),
        }
        return json.loads(json.dumps(fields))

    @classmethod
    def from_json(
        cls, fields: Mapping[str, Any], scenario: Scenario, solution: str | os.PathLike[str] | None = None
    ) -> "Campaign":
        """The campaign that `as_json` describes.

        Args:
          fields: the result of `as_json`.
          scenario: its scenario, which is resolved before because this may define disturbances.
          solution: the path of its solution.
        """
        check_kind("campaign", fields, Mapping, "what lqrsim wrote")
        try:
            design = fields["design_disturbances"]
            sweeps = {name: disturbances_from_json(some) for name, some in fields["sweeps"].items()}
            design = None if design is None else disturbances_from_json(design)
            campaign = cls(**{**fields, "solution": solution, "sweeps": sweeps, "design_disturbances": design})
        except InputError:
            raise
        except Exception as error:  # a disturbance may raise anything for settings that are not its own
            raise InputError(f"campaign: got {excerpt(fields)}, want one that lqrsim wrote ({error})") from None
        keep(campaign, resolved=check_kind("scenario", scenario, Scenario, "the campaign's Scenario"))
        return campaign


CAMPAIGN_FIELDS = tuple(one.name for one in dataclasses.fields(Campaign) if one.name != "solution")


def disturbances_as_json(disturbances: Iterable[Disturbance]) -> list[dict[str, Any]]:
    """The kind and the settings of each disturbance. Raises InputError if a setting is not plain data."""
    return [_disturbance_as_json(one) for one in disturbances]


def _disturbance_as_json(disturbance: Disturbance) -> dict[str, Any]:
    if not dataclasses.is_dataclass(disturbance):
        raise InputError(f"{type(disturbance).__name__}: got a class that is no dataclass, want a dataclass")
    settings = {field.name: getattr(disturbance, field.name) for field in dataclasses.fields(disturbance) if field.init}
    return {
        "kind": type(disturbance).__qualname__,
        "settings": {name: _as_json(value) for name, value in settings.items()},
    }


def _as_json(value: Any) -> Any:
    if isinstance(value, tuple | list):
        return [_as_json(one) for one in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _as_json(one) for name, one in value.items()}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise InputError(f"sweeps: got {excerpt(value)} in a disturbance, want numbers, strings, and lists of them")


def disturbances_from_json(items: Iterable[Mapping[str, Any]]) -> tuple[Disturbance, ...]:
    """The inverse of `disturbances_as_json`."""
    kinds = {kind.__qualname__: kind for kind in _kinds(Disturbance)}
    return tuple(
        kinds[check_name("disturbance", item["kind"], sorted(kinds))](
            **{name: _with_tuples(value) for name, value in item["settings"].items()}
        )
        for item in items
    )


def _with_tuples(value: Any) -> Any:
    return tuple(_with_tuples(one) for one in value) if isinstance(value, list) else value


def _kinds(base: type[Disturbance]) -> Iterator[type[Disturbance]]:
    """Every kind of disturbance that is defined, including users' own; the newer kind if a file was loaded twice."""
    for kind in base.__subclasses__():
        yield from _kinds(kind)
        defined = getattr(sys.modules.get(kind.__module__), kind.__qualname__, None) is kind
        if defined and not inspect.isabstract(kind):
            yield kind
