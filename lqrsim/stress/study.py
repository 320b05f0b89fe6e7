"""What is run: policies by name, and the records that state studies and campaigns of them.

A study is one policy of a scenario under disturbances; a campaign is many, with trials of each. Both are plain data,
which converts to JSON and back, and state the same `Setup`. A study becomes a plant and a controller in
`Study.closed_loop`, a campaign in `TrialRunner`.
"""

import dataclasses
import inspect
import itertools
import json
import logging
import os
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np

from lqrsim.annotations import Count, Index, Line, NonNegative, OneOf, Positive, Seed, Want, checked
from lqrsim.control.controllers import BeliefFeedback, Controller
from lqrsim.control.offset_free import OffsetFree
from lqrsim.control.replanner import Replanner
from lqrsim.control.tracking import track
from lqrsim.control.uncertainty import Uncertainty
from lqrsim.errors import InputError, check_items, check_kind, check_name, excerpt, keep
from lqrsim.problem.belief import Belief
from lqrsim.results.policy import AffinePolicy
from lqrsim.results.rollout import Rollout
from lqrsim.results.solution import Solution
from lqrsim.scenarios.packaged import Scenario
from lqrsim.scenarios.references import disturbance_set, from_anywhere, resolve
from lqrsim.scenarios.solutions import check_solution, difference, remarks, solve
from lqrsim.simulation.closed_loop import simulate
from lqrsim.simulation.disturbances import Disturbance, uncertainty_of

_log = logging.getLogger("lqrsim")


class PolicyKind(NamedTuple):
    """The way in which a policy is made."""

    solver: str = "smooth"
    controller: str = "feedback"
    designed: bool = False  # for disturbances that the user may choose
    per_cell: bool = False  # anew for the disturbances of each cell, at their strength


POLICY_KINDS = {
    "smooth": PolicyKind(),
    "ilqr": PolicyKind(solver="ilqr"),
    "open_loop": PolicyKind(),
    "replan": PolicyKind(controller="replan"),
    "track": PolicyKind(designed=True),  # `solve_policies` puts the tracking law into its solution
    "offset_free": PolicyKind(controller="offset_free", designed=True),
    "track_per_cell": PolicyKind(controller="track", per_cell=True),
    "offset_free_per_cell": PolicyKind(controller="offset_free", per_cell=True),
}
CAMPAIGN_POLICIES = tuple(POLICY_KINDS)
POLICIES = tuple(name for name, kind in POLICY_KINDS.items() if not kind.per_cell)  # also outside of a campaign
DESIGNED = tuple(name for name, kind in POLICY_KINDS.items() if kind.designed)
DEFAULT_POLICIES = tuple(name for name in POLICIES if name not in DESIGNED)
CONTROLLERS = ("feedback", "track", "offset_free", "replan")
DEFAULT_DESIGN = "moderate"  # the set for which policies are designed by default

Design = Sequence[Disturbance] | str | None  # disturbances, the name of a set, or None for the default


def check_designed(design: Design, policies: Sequence[str]) -> None:
    """Raise InputError if disturbances are given and none of the policies is designed for any."""
    if design is not None and not {*DESIGNED} & {*policies}:
        got = f"got them with {', '.join(policies)}"
        raise InputError(f"design_disturbances: {got}, want {' or '.join(DESIGNED)}, or leave them out")


def design_disturbances(scenario: Scenario, design: Design = None) -> Sequence[Disturbance]:
    """The disturbances for which "track" and "offset_free" are designed."""
    design = DEFAULT_DESIGN if design is None else design
    return disturbance_set(design, scenario) if isinstance(design, str) else design


def design_uncertainty(scenario: Scenario, design: Design = None) -> Uncertainty:
    """These disturbances as an Uncertainty. Raises InputError if the scenario's robot does not support one of them."""
    disturbances = design_disturbances(scenario, design)
    try:
        return uncertainty_of(scenario.plant(), disturbances)
    except InputError as error:
        raise InputError(f"design_disturbances: {error}") from None


def solve_policies(
    policies: Sequence[str], scenario: Scenario, design: Design = None, given: Solution | None = None, *,
    remark: bool = True,
) -> dict[str, Solution]:  # fmt: skip
    """The solution that each policy runs, by the policy's name.

    The policy in the solution for "track" is the tracking law, in that for "offset_free" the policy of "smooth".

    Args:
      given: a solution from `check_solution`, in place of the result of its solver.
      remark: whether to warn of plans that have not converged, or are of another problem.
    """
    check_used(given, policies)
    plans = {} if given is None else {solver_of(given): given}
    solutions: dict[str, Solution] = {}
    for policy in policies:
        solver = POLICY_KINDS[policy].solver
        if solver not in plans:
            plans[solver] = solve(scenario, solver)
        solutions[policy] = plans[solver].open_loop() if policy == "open_loop" else plans[solver]
    for solver, plan in plans.items():
        if not np.isfinite(plan.trajectory.states).all():
            raise InputError(f"policies: got a plan of {solver} that is {plan.status.name}, want a finite one")
        for line in remarks(scenario, plan) if remark else []:
            _log.warning("the solution of %s %s", solver, line)
    if "track" in policies:
        problem = scenario.with_duration_of(solutions["track"]).problem
        law = track(problem, solutions["track"], uncertainty=design_uncertainty(scenario, design))
        solutions["track"] = replace(solutions["track"], policy=law)
    return solutions


def solver_of(solution: Solution) -> str:
    """The solver whose result a given solution replaces."""
    return "ilqr" if solution.solver == "ilqr" else "smooth"


def check_used(given: Solution | None, policies: Sequence[str]) -> None:
    """Raise InputError if a solution is given and none of the policies uses it."""
    if given is None:
        return
    users = [policy for policy, kind in POLICY_KINDS.items() if kind.solver == solver_of(given)]
    if not {*users} & {*policies}:
        got = f"a solution of {given.solver} with {', '.join(policies)}"
        raise InputError(f"solution: got {got}, want it with {', '.join(users)}")


def impossible_policies(scenario: Scenario, given: Solution | None = None) -> dict[str, str]:
    """The policies that cannot run in the scenario with the given solution, if any, each with the reason."""
    impossible: dict[str, str] = {}
    if scenario.problem.constraints:
        impossible["ilqr"] = "which cannot keep the scenario's constraints"
    elif scenario.problem.duration is not None:
        impossible["ilqr"] = "which cannot find the scenario's free duration"
    if isinstance(scenario.problem.dynamics, Belief):
        others = (name for name, kind in POLICY_KINDS.items() if kind.controller != "feedback" or kind.designed)
        impossible |= dict.fromkeys(others, "which is of states, while the scenario is planned in belief space")
    if given is not None and solver_of(given) == POLICY_KINDS["replan"].solver:
        stated = scenario.with_duration_of(given).problem
        if given.problem_digest != stated.digest:
            other = f"another problem{difference(given, stated)}"
            impossible["replan"] = f"which re-plans the scenario's problem, while the solution is of {other}"
    return impossible


def make_controller(
    name: str, scenario: Scenario, solution: Solution, *, design: Design = None, replan_every: float | None = None
) -> Controller | AffinePolicy:
    """A controller for a solution of the scenario.

    Args:
      name: one of CONTROLLERS. "feedback" is the solution's policy, in belief space with its filter; "track" and
        "offset_free" are `lqrsim.track` and `lqrsim.OffsetFree` for its plan; "replan" re-plans during the run.
      replan_every: seconds between two solves of "replan"; by default a tenth of the horizon.
    """
    problem = scenario.with_duration_of(solution).problem
    if isinstance(problem.dynamics, Belief):
        if name != "feedback":
            raise InputError(f"controller: got {name} for a plan in belief space, want feedback")
        return BeliefFeedback(problem, solution)
    match check_name("controller", name, CONTROLLERS):
        case "track":
            return track(problem, solution, uncertainty=design_uncertainty(scenario, design))
        case "offset_free":
            read = scenario.plant().sensors(scenario.sensors) if scenario.sensors else None
            return OffsetFree(problem, solution, design_uncertainty(scenario, design), sensors=read)
        case "replan":
            if solution.problem_digest != problem.digest:
                other = difference(solution, problem)
                got = f"replan for a solution of another problem than that of {scenario.name}{other}"
                raise InputError(f"controller: got {got}; want one of its own, or {', '.join(CONTROLLERS[:-1])}")
            every = max(problem.dt, problem.steps * problem.dt / 10) if replan_every is None else replan_every
            return Replanner(problem, solution, every=every, deadline=0.0)
    return solution.policy


_MOST_FILES = 1_000_000  # largest number of shards in a folder

OF_SCENARIO = "of the scenario"  # the kind of a disturbance that is stored by its number in the scenario

Name = Annotated[str, Want("a name")]
SetName = Annotated[str, Want("a name, such as 'light'")]
Names = Annotated[Sequence[str], Want("a tuple of names")]
Disturbances = Annotated[tuple[Disturbance, ...], Want("a tuple of disturbances, such as (ControlNoise(0.05),)")]


@checked
@dataclass(frozen=True)
class Cell:
    """A combination of policy, disturbances and strength. All cells use the same random numbers."""

    policy: Name
    sweep: Name
    strength: NonNegative

    def __str__(self) -> str:
        return f"{self.policy},{self.sweep},{self.strength:g}"

    @classmethod
    @checked
    def named(cls, text: Line, cells: Annotated[Sequence["Cell"], Want("a list of Cell")]) -> "Cell":
        """The cell of a text: its number, from 0, or policy,sweep,strength."""
        if not cells:
            raise InputError("cells: got none, want at least one")
        if text.isdecimal() and len(text) < 10 and int(text) < len(cells):
            return cells[int(text)]
        for cell in cells:
            if text == str(cell):
                return cell
        raise InputError(f"cell: got {excerpt(text)}, want 0 to {len(cells) - 1}, or as {cells[0]} to {cells[-1]}")


@checked
@dataclass(frozen=True)
class Shard:
    """Consecutive trials of a cell that are run together and stored in one file."""

    cell_number: Index
    first: Index
    count: Count

    @property
    def file(self) -> str:
        """The name of its file: the numbers of the cell and of the first trial."""
        return f"{self.cell_number:04d}-{self.first:09d}.parquet"


@checked
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

    _prefix = ""

    scenario: Annotated[str, Want("a reference, such as 'quadrotor'"), 10_000]
    _: KW_ONLY
    solution: Solution | str | os.PathLike[str] | None = None
    design_disturbances: tuple[Disturbance, ...] | str | None = None
    goal_radius: Positive | None = None
    goal_tolerance: Positive | None = None
    seed: Seed = 0

    def __post_init__(self) -> None:
        keep(self, scenario=from_anywhere(self.scenario))  # workers and reports may run in other folders
        kinds = (Solution, str, os.PathLike, type(None))
        check_kind("solution", self.solution, kinds, "a Solution, the path of one, or None")
        if not isinstance(design := self.design_disturbances, str | None):
            keep(self, design_disturbances=check_items("design_disturbances", design, Disturbance, "disturbances"))

    @cached_property
    def resolved(self) -> Scenario:
        """The scenario, made once: a user's function may return another each time."""
        return resolve(self.scenario)

    @cached_property
    def given(self) -> Solution | None:
        """The solution that was given instead of solving, or None. Raises InputError if the solution does not fit."""
        return None if self.solution is None else check_solution(self.resolved, self.solution)

    @cached_property
    def goal_options(self) -> dict[str, Any]:
        """The goal options of `simulate`. Raises InputError if they do not fit the scenario."""
        self.resolved.target_radius(self.goal_radius, self.goal_tolerance)
        return self.resolved.near_enough(self.goal_radius, self.goal_tolerance)


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Study(Setup):
    """A policy of a scenario under disturbances. The scenario is solved when first needed.

    Attributes:
      sweep: the name of a set of disturbances, as in `lqrsim stress`; by default that of the scenario's demo.
      strength: factor by which the disturbances are scaled.
    """

    design_disturbances: SetName | None = None
    sweep: SetName = "scenario"
    strength: Positive = 1.0
    policy: Annotated[str, OneOf(POLICIES)] = "smooth"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_designed(self.design_disturbances, (self.policy,))

    @cached_property
    def disturbances(self) -> list[Disturbance]:
        """The disturbances of the set, scaled by the strength. Raises InputError if there is no such set."""
        return [kind.scaled(self.strength) for kind in disturbance_set(self.sweep, self.resolved)]

    @cached_property
    def closed_loop(self) -> dict[str, Any]:
        """The arguments of `funnel` and `TrialScore` but the disturbances: plant, solution, controller and goal."""
        scenario, policy, design = self.resolved, self.policy, self.design_disturbances
        goal = self.goal_options  # like the set, checked before the scenario is solved
        design = None if design is None else design_disturbances(scenario, design)
        # Whoever has a Solution at hand knows of which problem it is.
        remark = not isinstance(self.solution, Solution)
        solution = solve_policies((policy,), scenario, design, self.given, remark=remark)[policy]
        controller = make_controller(POLICY_KINDS[policy].controller, scenario, solution, design=design)
        plant = scenario.with_duration_of(solution).plant()
        return {"plant": plant, "solution": solution, "controller": controller, **goal}


@checked
@dataclass(frozen=True, kw_only=True)
class Campaign(Setup):
    """A stress test: trials of policies under disturbances of growing strength.

    Attributes:
      sweeps: name -> disturbances at strength 1. Those that are made of formulas, such as a `Noise`, can only be
        disturbances of the scenario, as in `Campaign.of_sets("my_robot.py:hallway", ["scenario"])`.
      strengths: factors by which the disturbances are scaled; 0.5 and 2 turn light into calm and moderate.
      policies: some of CAMPAIGN_POLICIES. "smooth" and "ilqr" come from lqrsim.smooth and lqrsim.ilqr; "open_loop" is
        the plan of smooth without feedback; "replan" re-plans during the run; "track" and "offset_free" follow the plan
        of smooth, with lqrsim.track and lqrsim.OffsetFree; "track_per_cell", "offset_free_per_cell" are designed anew
        for the disturbances of each cell, which no single policy knows. By default the first four.
      trials: number of trials for each sweep, strength and policy.
      replan_every: seconds between two solves of replan; by default a tenth of the horizon.
      shard: trials per file, which one worker runs; an interruption loses at most this many per worker.
      time_limit: seconds after which a shard counts as hung and its trials as errors.
    """

    design_disturbances: Disturbances | None = None
    sweeps: Mapping[str, Disturbances]
    strengths: tuple[NonNegative, ...] = (0.0, 0.5, 1.0, 1.5, 2.0)
    policies: tuple[Annotated[str, OneOf(CAMPAIGN_POLICIES)], ...] = DEFAULT_POLICIES
    trials: Count = 200
    replan_every: Positive | None = None
    shard: Count = 500
    time_limit: Positive = 300.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.sweeps:
            raise InputError("sweeps: got none, want at least one: name -> disturbances")
        for name in self.sweeps:
            if "," in name or not name:
                raise InputError(f"sweeps: got the name {excerpt(name)}, want one without a comma")
        for field in ("strengths", "policies"):
            values = getattr(self, field)
            if not values or len(set(values)) < len(values):
                raise InputError(f"{field}: got {excerpt(values)}, want at least one entry, each at most once")
        check_designed(self.design_disturbances, self.policies)
        if self.design_disturbances is not None and not self.design_disturbances:
            raise InputError("design_disturbances: got none, want at least one disturbance, or None for the default")
        files = -(-self.trials // self.shard) * len(self.cells)
        if files > _MOST_FILES:
            got = f"{self.trials} in shards of {self.shard} for {len(self.cells)} cells, which takes {files} files"
            raise InputError(f"trials: got {got}, want at most {_MOST_FILES}: fewer trials, or larger shards")

    @classmethod
    @checked
    def of_sets(
        cls, scenario: str, sets: Names, *, design_disturbances: SetName | None = None, policies: Names = (),
        **options: Any,
    ) -> "Campaign":  # fmt: skip
        """A campaign whose disturbances are sets by name, as in `lqrsim stress`.

        Args:
          sets: names of the sweeps.
          design_disturbances: the name of a set, too.
          policies: as in `Campaign`; by default those of the first four that the scenario allows.
          **options: the other attributes of `Campaign`.
        """
        bare = cls(scenario, sweeps=dict.fromkeys(sets, ()), **options)
        impossible, design = impossible_policies(bare.resolved, bare.given), design_disturbances
        campaign = dataclasses.replace(
            bare,
            sweeps={name: disturbance_set(name, bare.resolved) for name in sets},
            design_disturbances=None if design is None else disturbance_set(design, bare.resolved),
            policies=policies or tuple(policy for policy in DEFAULT_POLICIES if policy not in impossible),
        )
        keep(campaign, resolved=bare.resolved, given=bare.given)
        return campaign

    @property
    def cells(self) -> list[Cell]:
        """All combinations, in the order of their numbers."""
        combinations = itertools.product(self.sweeps, self.strengths, self.policies)
        return [Cell(policy, sweep, strength) for sweep, strength, policy in combinations]

    @checked
    def disturbances(self, cell: Cell) -> list[Disturbance]:
        """The disturbances of a cell's trials."""
        check_name("cell: sweep", cell.sweep, self.sweeps)
        return [disturbance.scaled(cell.strength) for disturbance in self.sweeps[cell.sweep]]

    def as_json(self) -> dict[str, Any]:
        """The campaign as plain data without its solution, from which `from_json` makes it again."""
        design = self.design_disturbances
        fields = {name: getattr(self, name) for name in CAMPAIGN_FIELDS} | {
            "sweeps": {name: disturbances_as_json(sweep, self.resolved) for name, sweep in self.sweeps.items()},
            "design_disturbances": None if design is None else disturbances_as_json(design, self.resolved),
        }
        return json.loads(json.dumps(fields))

    @classmethod
    @checked
    def from_json(
        cls, fields: Mapping[str, Any], scenario: Scenario, solution: str | os.PathLike[str] | None = None
    ) -> "Campaign":
        """The campaign that `as_json` describes. Its scenario, which may define disturbances, is resolved before."""
        try:
            design = fields["design_disturbances"]
            sweeps = {name: disturbances_from_json(sweep, scenario) for name, sweep in fields["sweeps"].items()}
            design = None if design is None else disturbances_from_json(design, scenario)
            campaign = cls(**{**fields, "solution": solution, "sweeps": sweeps, "design_disturbances": design})
        except InputError:
            raise
        except Exception as error:  # a disturbance may raise anything for settings that are not its own
            raise InputError(f"campaign: got {excerpt(fields)}, want one that lqrsim wrote ({error})") from None
        keep(campaign, resolved=scenario)
        return campaign


CAMPAIGN_FIELDS = tuple(field.name for field in dataclasses.fields(Campaign) if field.name != "solution")


class TrialRunner:
    """Runs the trials of a campaign's cells, each policy with its solution."""

    def __init__(self, campaign: Campaign, solutions: Mapping[str, Solution]) -> None:
        self.campaign, self.solutions = campaign, solutions
        plan = next(iter(solutions.values()))  # all plans have the same duration
        self.scenario = campaign.resolved.with_duration_of(plan)
        self.plant = self.scenario.plant()
        self._controllers: dict[Cell | str, Controller | AffinePolicy] = {}

    def run(self, cell: Cell, first: int, count: int = 1, *, frames: bool, contacts: bool) -> Rollout:
        campaign = self.campaign
        return simulate(
            self.plant, self.solutions[cell.policy], controller=self.controller(cell), threads=1,
            disturbances=campaign.disturbances(cell), **campaign.goal_options, seed=campaign.seed, trials=count,
            first_trial=first, frames=frames, contacts=contacts,
        )  # fmt: skip

    def controller(self, cell: Cell) -> Controller | AffinePolicy:
        """The controller of a cell, made once for its policy or for the cell, because its gains take time."""
        kind, campaign, solution = POLICY_KINDS[cell.policy], self.campaign, self.solutions[cell.policy]
        key = cell if kind.per_cell else cell.policy
        if key not in self._controllers:
            design = campaign.disturbances(cell) if kind.per_cell else campaign.design_disturbances
            self._controllers[key] = make_controller(
                kind.controller, self.scenario, solution, design=design, replan_every=campaign.replan_every
            )
        return self._controllers[key]


def disturbances_as_json(
    disturbances: Iterable[Disturbance], scenario: Scenario, strength: float | None = None
) -> list[dict[str, Any]]:
    """The kind and the settings of each disturbance, scaled by a strength if there is one.

    The scenario's own may have formulas, which are no plain data: these are stated by their number among its own.
    Raises InputError if a setting of another is no plain data.
    """
    numbers = {id(disturbance): number for number, disturbance in enumerate(scenario.disturbances)}
    items = list[dict[str, Any]]()
    for disturbance in disturbances:
        scaled = disturbance if strength is None else disturbance.scaled(strength)
        kind = type(scaled)
        if not dataclasses.is_dataclass(scaled):
            raise InputError(f"{kind.__name__}: got a class that is no dataclass, want a dataclass")
        settings = {field.name: getattr(scaled, field.name) for field in dataclasses.fields(scaled) if field.init}
        try:
            item = {"kind": kind.__qualname__, "settings": json.loads(json.dumps(settings, default=_plain))}
        except InputError:
            if id(disturbance) not in numbers:
                raise
            settings = {"number": numbers[id(disturbance)], "text": scaled.describe(scenario.plant())}
            item = {"kind": OF_SCENARIO, "settings": settings}
        items.append(item)
    return items


def _plain(value: Any) -> Any:
    """A value of a disturbance that JSON has no form for."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise InputError(f"sweeps: got {excerpt(value)} in a disturbance, want numbers, strings, and lists of them")


def disturbances_from_json(items: Iterable[Mapping[str, Any]], scenario: Scenario) -> tuple[Disturbance, ...]:
    """The inverse of `disturbances_as_json`."""
    kinds = {kind.__qualname__: kind for kind in _kinds(Disturbance)}
    return tuple(
        scenario.disturbances[item["settings"]["number"]]
        if item["kind"] == OF_SCENARIO
        else kinds[check_name("disturbance", item["kind"], sorted(kinds))](
            **{name: _with_tuples(value) for name, value in item["settings"].items()}
        )
        for item in items
    )


def _with_tuples(value: Any) -> Any:
    return tuple(_with_tuples(item) for item in value) if isinstance(value, list) else value


def _kinds(base: type[Disturbance]) -> Iterator[type[Disturbance]]:
    """Every kind of disturbance that is defined, including users' own; the newer kind if a file was loaded twice."""
    for kind in base.__subclasses__():
        yield from _kinds(kind)
        defined = getattr(sys.modules.get(kind.__module__), kind.__qualname__, None) is kind
        if defined and not inspect.isabstract(kind):
            yield kind
