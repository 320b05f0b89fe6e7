"""What a campaign is asked to do: plain data, to JSON and back."""

import dataclasses
import inspect
import itertools
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

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
)
from lqrsim.scenarios.references import from_anywhere
from lqrsim.simulation.disturbances import Disturbance

_FILES = 1_000_000  # of shards in a folder


class PolicyKind(NamedTuple):
    """How a policy is made.

    Attributes:
      solver: finds its plan.
      controller: runs it, one of `trials.CONTROLLERS`.
      told: whether it is made for stated disturbances.
    """

    solver: str = "smooth"
    controller: str = "feedback"
    told: bool = False


KINDS = {
    "smooth": PolicyKind(),
    "ilqr": PolicyKind(solver="ilqr"),
    "open_loop": PolicyKind(),
    "replan": PolicyKind(controller="replan"),
    "track": PolicyKind(told=True),  # its law is the policy of its solution
    "offset_free": PolicyKind(controller="offset_free", told=True),
}
POLICIES = tuple(KINDS)
TOLD = tuple(policy for policy, kind in KINDS.items() if kind.told)
USUAL = tuple(policy for policy, kind in KINDS.items() if not kind.told)  # which are run unless others are asked for


@dataclass(frozen=True)
class Cell:
    """A combination of policy, sweep and strength. All cells share the trials' random numbers.

    Attributes:
      policy: its name; see `Campaign`.
      sweep: name of the disturbances.
      strength: factor by which they are scaled, 0 or more.

    Raises:
      InputError: a name is empty or no text, or the strength is negative or not finite.
    """

    policy: str
    sweep: str
    strength: float

    def __post_init__(self) -> None:
        for name in ("policy", "sweep"):
            check_text(f"Cell: {name}", getattr(self, name), "a name")
        object.__setattr__(self, "strength", check_number("Cell: strength", self.strength, at_least=0.0))

    def __str__(self) -> str:
        return f"{self.policy},{self.sweep},{self.strength:g}"

    @classmethod
    def named(cls, text: str, cells: Sequence["Cell"]) -> "Cell":
        """One of `cells`, by its number or as policy,sweep,strength.

        Args:
          text: the number, from 0, or the three separated by commas.
          cells: the cells to choose from.

        Returns:
          The Cell.

        Raises:
          InputError: there is no such cell.
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
    """The unit of work, which is lost or kept as a whole: some trials of a cell, which go into one file."""

    cell: int
    first: int
    count: int

    def __post_init__(self) -> None:
        for name, least in (("cell", 0), ("first", 0), ("count", 1)):
            check_count(f"Shard: {name}", getattr(self, name), at_least=least)

    @property
    def file(self) -> str:
        """The name of its file: the number of the cell and that of the first trial."""
        return f"{self.cell:04d}-{self.first:09d}.parquet"


def shards_of(cell: int, trials: int, size: int) -> Iterator[Shard]:
    """The shards of the cell with that number."""
    for first in range(0, trials, size):
        yield Shard(cell, first, min(size, trials - first))


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """The specification of a stress test.

    Attributes:
      scenario: what is run, as `lqrsim solve` takes it.
      sweeps: name -> disturbances at strength 1.
      strengths: what they are multiplied by.
      policies: which of POLICIES: "smooth" is lqrsim.smooth's, "ilqr" that of lqrsim.ilqr; "open_loop" is the plan of
        smooth without feedback; "replan" solves again and again as it goes; "track" and "offset_free" keep to the plan
        of smooth, by lqrsim.track and lqrsim.OffsetFree. By default the first four.
      stated: the disturbances that "track" and "offset_free" are made for, whatever they then meet; by default those of
        the preset "moderate", for one policy has to do for all strengths, and that is in the middle.
      trials: of each cell.
      seed: of all random numbers.
      replan_every: seconds between two solves of "replan"; by default a tenth of the horizon.
      goal_radius: in metres, within which the goal counts as reached, as in `simulate`; by default the scenario's.
      goal_tolerance: the same as a scaled error, for robots without a position; by default the scenario's.
      shard: trials of a file.
      time_limit: seconds that a shard may take before it counts as hung.

    Raises:
      InputError: something is not as described.
    """

    scenario: str
    sweeps: Mapping[str, tuple[Disturbance, ...]]
    strengths: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0)
    policies: tuple[str, ...] = USUAL
    trials: int = 200
    seed: int = 0
    replan_every: float | None = None
    goal_radius: float | None = None
    goal_tolerance: float | None = None
    shard: int = 500
    time_limit: float = 300.0
    stated: tuple[Disturbance, ...] | None = None

    def __post_init__(self) -> None:
        check_text("scenario", self.scenario, "a reference, such as 'quadrotor'", at_most=4000)
        if not isinstance(self.sweeps, Mapping) or not self.sweeps:
            raise InputError(f"sweeps: got {excerpt(self.sweeps)}, want at least one: name -> disturbances")
        object.__setattr__(self, "scenario", from_anywhere(self.scenario))  # workers and reports may be elsewhere
        sweeps: dict[str, tuple[Disturbance, ...]] = {}
        for name, disturbances in self.sweeps.items():
            check_text("sweeps: name", name, "a name without a comma")
            if "," in name:
                raise InputError(f"sweeps: got the name {excerpt(name)}, want one without a comma")
            wanted = "a tuple of disturbances, such as (ControlNoise(0.05),)"
            sweeps[name] = check_items(f"sweeps: {name}", disturbances, Disturbance, wanted)
        strengths = check_items("strengths", self.strengths, object, "a tuple of numbers", at_most=1000)
        numbers = tuple(check_number("strengths", strength, at_least=0.0) for strength in strengths)
        policies = check_items("policies", self.policies, object, f"a tuple of {', '.join(POLICIES)}", at_most=100)
        for policy in policies:
            check_name("policies", policy, POLICIES)
        for field, values in (("strengths", numbers), ("policies", policies)):
            if not values or len(set(values)) < len(values):
                raise InputError(f"{field}: got {excerpt(values)}, want at least one, and each once")
            object.__setattr__(self, field, values)
        object.__setattr__(self, "sweeps", sweeps)
        if self.stated is not None:
            check_told("stated", policies)
            wanted = "a tuple of disturbances, such as (ControlNoise(0.05),)"
            stated = check_items("stated", self.stated, Disturbance, wanted)
            if not stated:
                raise InputError("stated: got none, want at least one disturbance, or None for the default")
            object.__setattr__(self, "stated", stated)
        for field in ("trials", "shard"):
            object.__setattr__(self, field, check_count(field, getattr(self, field)))
        object.__setattr__(self, "seed", check_seed("seed", self.seed))
        files = -(-self.trials // self.shard) * len(self.cells)
        if files > _FILES:
            raise InputError(
                f"trials: got {self.trials} in shards of {self.shard} for {len(self.cells)} cells, which are {files}"
                f" files, want at most {_FILES}: fewer, or a larger shard"
            )
        for field in ("replan_every", "goal_radius", "goal_tolerance"):
            if (value := getattr(self, field)) is not None:
                object.__setattr__(self, field, check_number(field, value, above=0.0))
        object.__setattr__(self, "time_limit", check_number("time_limit", self.time_limit, above=0.0))

    @property
    def cells(self) -> list[Cell]:
        """All combinations, in the order of their numbers."""
        together = itertools.product(self.sweeps, self.strengths, self.policies)
        return [Cell(policy, sweep, strength) for sweep, strength, policy in together]

    def shards(self) -> Iterator[Shard]:
        """All of the work, in order."""
        for number in range(len(self.cells)):
            yield from shards_of(number, self.trials, self.shard)

    def disturbances(self, cell: Cell) -> list[Disturbance]:
        """The disturbances that the trials of a cell meet.

        Args:
          cell: one of the campaign's.

        Returns:
          The disturbances, scaled by the cell's strength.

        Raises:
          InputError: the cell belongs to another campaign.
        """
        check_kind("cell", cell, Cell, "a Cell of the campaign")
        check_name("cell: sweep", cell.sweep, self.sweeps)
        return [disturbance.scaled(cell.strength) for disturbance in self.sweeps[cell.sweep]]

    def as_json(self) -> dict[str, Any]:
        """What `from_json` makes the same campaign of."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        sweeps = {
            name: [disturbance_as_json(disturbance) for disturbance in sweep] for name, sweep in self.sweeps.items()
        }
        stated = None if self.stated is None else [disturbance_as_json(disturbance) for disturbance in self.stated]
        lists = {"strengths": list(self.strengths), "policies": list(self.policies)}
        return fields | {"sweeps": sweeps, "stated": stated} | lists

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> "Campaign":
        """The campaign that `as_json` described; its scenario must have been resolved, if it has its own disturbances.

        Args:
          fields: what `as_json` returned.

        Returns:
          A Campaign equal to the one described.

        Raises:
          InputError: it is damaged, or has a disturbance that is not known here.
        """
        check_kind("campaign", fields, Mapping, "what lqrsim wrote")
        try:
            sweeps = {
                name: tuple(_disturbance_from_json(one) for one in sweep) for name, sweep in fields["sweeps"].items()
            }
            stated = fields["stated"]
            if stated is not None:
                stated = tuple(_disturbance_from_json(one) for one in stated)
            return cls(**{**fields, "sweeps": sweeps, "stated": stated})
        except InputError:
            raise
        except Exception as error:  # whatever a disturbance raises of settings that are not its own
            raise InputError(f"campaign: got {excerpt(fields)}, want what lqrsim wrote ({error})") from None


def check_told(field: str, policies: Sequence[str]) -> None:
    """Raise InputError if none of the policies is made for stated disturbances."""
    if not {*TOLD} & {*policies}:
        raise InputError(f"{field}: got it with {', '.join(policies)}, want it with {' or '.join(TOLD)}, or none")


def disturbance_as_json(disturbance: Disturbance) -> dict[str, Any]:
    """Its kind and settings, for JSON. Raises InputError where they are not plain."""
    if not dataclasses.is_dataclass(disturbance):
        raise InputError(f"{type(disturbance).__name__}: got a class of its own kind, want a dataclass")
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


def _disturbance_from_json(fields: Mapping[str, Any]) -> Disturbance:
    kinds = {kind.__qualname__: kind for kind in _kinds(Disturbance)}
    settings = {name: _with_tuples(value) for name, value in fields["settings"].items()}
    return kinds[check_name("disturbance", fields["kind"], sorted(kinds))](**settings)


def _with_tuples(value: Any) -> Any:
    return tuple(_with_tuples(one) for one in value) if isinstance(value, list) else value


def _kinds(base: type[Disturbance]) -> Iterator[type[Disturbance]]:
    """Every kind that is defined here, users' own too; of one whose file was loaded twice, the newer."""
    for kind in base.__subclasses__():
        yield from _kinds(kind)
        defined = getattr(sys.modules.get(kind.__module__), kind.__qualname__, None) is kind
        if defined and not inspect.isabstract(kind):
            yield kind
