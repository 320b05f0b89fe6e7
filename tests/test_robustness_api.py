"""Hostile calls of the public API: one clear line of InputError, whatever is passed; a sample of what
tests/tools/benchmark_robustness.py tries, and the cases that once were not refused."""

import ast
import contextlib
import copy
import dataclasses
import inspect
import itertools
import logging
import math
import pkgutil
import re
import signal
import typing
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusing import refusal
from sampling import examples, rarely

import lqrsim as ls
from lqrsim.codegen.language import Group
from lqrsim.codegen.printer import Value
from lqrsim.commands.solving import tube_under
from lqrsim.disturbances import Uncertainty
from lqrsim.errors import (
    InputError,
    check_array,
    check_count,
    check_function,
    check_items,
    check_memory,
    check_number,
    check_path,
    check_text,
    excerpt,
)
from lqrsim.machine import memory
from lqrsim.problem.parts import CostTerm
from lqrsim.results.solution_parts import BetweenKnots
from lqrsim.stress import Campaign
from lqrsim.stress.statistics import rate

api: Any = import_module("robustness.api")
of_runs: Any = import_module("robustness.of_runs")
subjects: Any = import_module("robustness.subjects")
lq: Any = ls  # whose types nobody checks


@pytest.fixture(scope="module")
def caller(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Of the calls of a seed; what it calls takes seconds to make."""
    logger = logging.getLogger("lqrsim")
    level = logger.level
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("subjects"))
        try:
            made = api.Caller(Path.cwd(), seed=1)
        finally:
            logger.setLevel(level)
        yield made


@pytest.mark.parametrize("apart", [False, *rarely(True)])
def test_a_sample_of_hostile_calls(caller: Any, apart: bool) -> None:
    """Here; with the long tests in a process of their own, as the benchmark makes them."""
    count = examples(60)
    verdicts = list(api.calls(count, seed=1)) if apart else [caller(number) for number in range(count)]
    assert len(verdicts) == count
    assert not [verdict for verdict in verdicts if verdict.failed]
    kinds = {verdict.kind for verdict in verdicts}
    assert {"accepted", "refused"} <= kinds


def test_every_public_callable_is_tried(caller: Any) -> None:
    """What __all__ lists has arguments that are accepted as they are."""
    tried = caller.subjects
    assert {name for name, _ in subjects.public()} <= tried.keys()
    for name in ("smooth", "simulate", "Problem", "AffinePolicy.__call__", "Campaign", "render", "rotations.rotate"):
        assert name in tried
    for name, subject in tried.items():
        try:
            made = subject.call(**subject.arguments)
            api.exercise(made)
            assert not api.printed_address(made), name
            if dataclasses.is_dataclass(made) and not isinstance(made, type):
                other = copy.copy(made)
                assert made == made, name
                assert isinstance(made == other, bool), name
                assert made in [other, made], name
                if type(made).__eq__ is object.__eq__:
                    assert len({made, other, made}) == 2, name
        except InputError as error:
            raise AssertionError(name) from error


def annotation(kind: type, field: dataclasses.Field[Any]) -> str:
    """Type of a field with the full names of classes; as written if a class is imported for the type checker alone."""
    with contextlib.suppress(NameError):
        return str(typing.get_type_hints(kind)[field.name])
    return str(field.type)


def test_records_of_arrays_equal_themselves_alone() -> None:
    """All records of the package, by their annotations: those with an array, and those with such a record in them.

    Exceptions are stated by arrays and keep tuples, or are types of compiled code, which are no arrays.
    """
    values = (ls.disturbances.Disturbance, Uncertainty, Campaign, Group, Value)
    kinds = {
        kind
        for module in pkgutil.walk_packages(ls.__path__, "lqrsim.")
        for kind in vars(import_module(module.name)).values()
        if inspect.isclass(kind) and dataclasses.is_dataclass(kind) and kind.__module__.startswith("lqrsim.")
    }
    texts = {kind: [annotation(kind, field) for field in dataclasses.fields(kind) if field.compare] for kind in kinds}
    found: set[type] = set()
    while True:
        names = "|".join(
            [r"numpy\.ndarray|NDArray", *(re.escape(f"{kind.__module__}.{kind.__name__}") for kind in found)]
        )
        more = {kind for kind in kinds if any(re.search(rf"({names})\b", text) for text in texts[kind])}
        more |= {kind for kind in kinds if any(issubclass(kind, one) for one in found)}
        if more == found:
            break
        found = more
    assert len(found) > 60
    assert not [kind.__name__ for kind in found if kind.__eq__ is not object.__eq__ and not issubclass(kind, values)]


def arrays_in(value: Any) -> list[np.ndarray]:
    """The arrays of a value: itself, or those of a tuple or a list."""
    found = value if isinstance(value, tuple | list) else [value]
    return [one for one in found if isinstance(one, np.ndarray)]


def test_frozen_records_own_their_arrays(caller: Any) -> None:
    """What the caller writes into an array later changes no record that was made from it."""
    tried = 0
    for name, subject in caller.subjects.items():
        kind = subject.call
        if not (inspect.isclass(kind) and dataclasses.is_dataclass(kind)):
            continue
        copies = {key: value.copy() for key, value in subject.arguments.items() if isinstance(value, np.ndarray)}
        frozen = kind.__dataclass_params__.frozen  # pyright: ignore[reportAttributeAccessIssue]
        if not copies or not frozen or kind is ls.disturbances.Effect:
            continue
        made = kind(**{**subject.arguments, **copies})
        mine = [one for field in dataclasses.fields(made) for one in arrays_in(getattr(made, field.name, None))]
        tried += len(mine)
        assert not [key for key, copy in copies.items() if any(np.shares_memory(copy, one) for one in mine)], name
    assert tried > 50


@pytest.mark.parametrize("numbers", [0.1, (0.1, 0.2), np.array([0.1, 0.2])])
@pytest.mark.parametrize("kind", [lambda it: Uncertainty(measurement=it), ls.disturbances.MeasurementNoise])
def test_what_is_stated_by_numbers_equals_the_same_numbers(kind: Callable[[Any], Any], numbers: Any) -> None:
    one, same, other = kind(numbers), kind(copy.copy(numbers)), kind(np.add(numbers, 0.1))
    assert one == same
    assert one != other
    assert len({one, same, other}) == 2


class TestTheFuzzer:
    """It sees what it is there to see."""

    def verdict(self, call: Callable[..., object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
        monkeypatch.setattr(api, "subjects", lambda folder: {"f": subjects.Subject(call, {"a": 1})})
        monkeypatch.chdir(tmp_path)
        return api.Caller(tmp_path, seed=0)(0)

    @pytest.mark.parametrize(
        ("error", "kind"),
        [(InputError("a: got 1, want 2"), "refused"), (InputError(""), "raw"), (KeyError("a"), "raw")],
    )
    def test_what_is_raised(self, error: Exception, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        # Raised from elsewhere than the folder of the fuzzer's own functions.
        namespace: dict[str, Any] = {"error": error}
        exec(compile("def call(a):\n    raise error", "/elsewhere/call.py", "exec"), namespace)
        assert self.verdict(namespace["call"], tmp_path, monkeypatch).kind == kind

    def test_what_hangs(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(api, "PATIENCE", 0.2)

        def call(a: object) -> None:
            while True:
                pass

        assert self.verdict(call, tmp_path, monkeypatch).kind == "hang"
        assert signal.getitimer(signal.ITIMER_PROF) == (0.0, 0.0)

    def test_the_same_number_is_the_same_call(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        seen = []
        for _ in range(2):
            self.verdict(lambda a: seen.append(repr(type(a))), tmp_path, monkeypatch)
        assert seen[0] == seen[1]


class Raising:
    """Whatever it is asked, it raises."""

    def __repr__(self) -> str:
        raise RuntimeError("no")

    __len__ = __iter__ = __float__ = __array__ = __fspath__ = __index__ = __repr__  # type: ignore[assignment]


class Named:
    """Without a text of its own."""

    def method(self) -> None: ...


class TestChecks:
    def test_objects_are_named_by_their_kind_not_by_their_address(self) -> None:
        for value, text in (
            (Named(), "a Named"), ([Named(), 1], "[a Named, 1]"), ({"law": object()}, "{'law': an object}"),
            (Named().method, "<bound method Named.method of a Named>"), (refusal, "<function refusal>"),
        ):  # fmt: skip
            assert excerpt(value) == text

    def test_a_replanner_for_which_there_is_no_tube_is_named(self) -> None:
        scenario = ls.scenarios.quadrotor()
        solution = ls.smooth(scenario.problem, max_iterations=1, stop="cost", starts=1)
        replanner = ls.Replanner(scenario.problem, solution, every=1.0)
        tube, told = tube_under(
            scenario.problem, solution, scenario.plant(), [ls.disturbances.ControlNoise(0.1)], replanner
        )
        assert tube is None
        said = "got Replanner(every 1 s, with a shrinking horizon), want an OffsetFree or an AffinePolicy"
        assert told == f"no predicted tube: predict_tube: controller: {said}"

    @pytest.mark.parametrize(
        "value",
        ["1", b"1", 1j, np.array([1j]), np.array("1"), ["1", "2"], {"a": 1}, (i for i in range(3)), [[1], [1, 2]], None,
         np.zeros(3, "datetime64[s]"), Raising(), [Raising()], object],
    )  # fmt: skip
    def test_what_is_no_array(self, value: Any) -> None:
        assert refusal(lambda: check_array("weight", value, (3,))).startswith("weight: got ")

    @pytest.mark.parametrize("value", ["1", True, [1.0], np.array([1.0]), 1j, 10**400, math.nan, math.inf, Raising()])
    def test_what_is_no_number(self, value: Any) -> None:
        assert "want a finite number" in refusal(lambda: check_number("dt", value))

    @given(st.floats(-1e9, 1e9), st.floats(0, 1e9), st.booleans())
    def test_a_refused_number_is_outside_the_bounds_as_they_are_stated(self, low: float, more: float, up: bool) -> None:
        """A bound that is printed with fewer digits than it has may seem to be kept."""
        high = low + more
        value = np.nextafter(high, math.inf) if up else np.nextafter(low, -math.inf)
        said = refusal(lambda: check_number("std", value, at_least=low, at_most=high))
        stated = re.fullmatch(r"std: got .*, want a finite number >= (\S+) and <= (\S+)", said)
        assert stated is not None
        assert not float(stated[1]) <= value <= float(stated[2])

    @pytest.mark.parametrize("value", [1.0, "1", True, 0, -1, 10**20, 10**400, 2**31, np.float64(3), None])
    def test_what_is_no_count(self, value: Any) -> None:
        assert refusal(lambda: check_count("trials", value, at_most=2**31 - 1)).startswith("trials: got ")

    def test_numbers_of_numpy_are_numbers(self) -> None:
        assert check_number("dt", np.float32(0.5)) == check_number("dt", np.array(0.5)) == 0.5
        assert check_count("steps", np.int32(3)) == 3

    def test_an_endless_collection(self) -> None:
        assert "more than 5" in refusal(lambda: check_items("problems", itertools.count(), int, "numbers", at_most=5))

    @pytest.mark.parametrize("value", ["", "\0", "x" * 300, "\ud800", b"a", None, 3, Raising()])
    def test_what_is_no_path(self, value: Any) -> None:
        assert refusal(lambda: check_path("out", value)).startswith("out: got ")

    @pytest.mark.parametrize("value", ["two\nlines", "", "x" * 300, "\0", 3])
    def test_what_is_no_line_of_text(self, value: Any) -> None:
        assert refusal(lambda: check_text("title", value)).startswith("title: got ")

    def test_a_function_of_other_arguments(self) -> None:
        assert "does not take 2" in refusal(lambda: check_function("progress", lambda a: a, "one of two", arguments=2))

    def test_an_excerpt_is_one_short_line(self) -> None:
        nested: list[Any] = []
        for _ in range(100_000):
            nested = [nested]
        for value in (nested, Raising(), "x\n" * 10**6, 10**10_000, list(range(10**6)), np.zeros((50, 50)), "\x1b[2J"):
            assert len(excerpt(value)) <= 60
            assert excerpt(value).isprintable()

    @pytest.mark.parametrize("kind", [list, tuple, dict])
    def test_records_print_lists_within_lists_without_end(self, kind: type) -> None:
        endless: list[Any] = []
        endless.append(endless)
        deep: Any = kind()
        for _ in range(100_000):
            deep = {"a": deep} if kind is dict else kind([deep])
        values: list[Any] = [deep, endless]
        for value in values:
            assert f"a {type(value).__name__}" in repr(BetweenKnots(0.0, 0.0, {"clearance": value}))

    def test_memory_is_that_of_the_machine_and_its_limits(self) -> None:
        assert memory() > 2**28
        line = refusal(lambda: check_memory("steps", 2**31, memory() // 2**20))
        assert line.startswith("steps: got 2147483648, whose arrays would take ")
        assert "want at most 1048" in line


COUNTS = (2**31, 10**20)


class TestCounts:
    """Each has a limit, or is refused where the machine has not the memory."""

    @pytest.mark.parametrize("count", COUNTS)
    def test_of_solvers(self, count: int, differential_drive: ls.Scenario) -> None:
        problem = differential_drive.problem
        assert "steps: got" in refusal(lambda: dataclasses.replace(problem, steps=count))
        for options in ({"starts": count}, {"threads": count}, {"max_iterations": count}):
            name = next(iter(options))
            assert refusal(lambda o=options: lq.smooth(problem, **o)).startswith(f"{name}: got {count}, want a whole")

    @pytest.mark.parametrize("count", COUNTS)
    def test_of_runs(self, count: int, differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
        plant = differential_drive.plant()
        assert refusal(lambda: ls.simulate(plant, drive_solution, trials=count)).startswith(f"trials: got {count}, ")
        assert "16" not in refusal(lambda: ls.simulate(plant, drive_solution, trials=10**8)).split(", want")[1][:3]
        assert "threads" in refusal(lambda: ls.simulate(plant, drive_solution, threads=count))
        robot, scene = differential_drive.robot, differential_drive.scene
        assert "samples" in refusal(lambda: ls.check_plant(robot, scene, samples=count))
        assert "samples" in refusal(lambda: ls.check_derivatives(robot.dynamics, samples=count))

    @pytest.mark.parametrize("count", COUNTS)
    @pytest.mark.parametrize("name", ["size", "particles", "moves", "repetitions", "most_levels"])
    def test_of_splitting(self, name: str, count: int) -> None:
        options = {"size": 2, name: count}
        said = refusal(lambda: lq.stress.failure_probability(lambda z: z[:, 0], **options))
        assert said.startswith(f"{name}: got {count}, ")

    def test_of_campaigns(self, tmp_path: Path) -> None:
        campaign = ls.stress.Campaign(
            scenario="quadrotor", sweeps={"noise": (ls.disturbances.ControlNoise(0.1),)}, trials=1
        )
        assert "workers" in refusal(lambda: ls.stress.run_campaign(campaign, tmp_path / "a", workers=2**31))
        assert "trials" in refusal(lambda: dataclasses.replace(campaign, trials=10**20))

    def test_a_control_period_that_the_physics_never_ends(
        self, differential_drive: ls.Scenario, drive_solution: ls.Solution
    ) -> None:
        slow = dataclasses.replace(drive_solution.trajectory, dt=1e9)
        line = refusal(
            lambda: ls.simulate(differential_drive.plant(), dataclasses.replace(drive_solution, trajectory=slow))
        )
        assert "physics steps" in line
        # Each period is short enough, and all of them are not.
        steps, n, m = 10_000, 3, 2
        plan = ls.Trajectory(np.zeros((steps + 1, n)), np.zeros((steps, m)), dt=100.0)
        policy = dataclasses.replace(
            drive_solution.policy,
            gain=np.zeros((steps, m, n)),
            offset=plan.controls,
            nominal=plan.states[:-1],
            dt=100.0,
        )
        endless = dataclasses.replace(
            drive_solution, trajectory=plan, policy=policy, inverse_policy=None, cost_to_go=None, cost_to_come=None,
            clearance=None, candidates=(), multipliers=(),
        )  # fmt: skip
        line = refusal(lambda: ls.simulate(differential_drive.plant(), endless))
        assert "10000 control periods of 100 s, which takes 120000000 physics steps, want at most 100000000" in line


class TestDataThatUsersBuild:
    def test_a_policy(self, drive_solution: ls.Solution) -> None:
        policy = drive_solution.policy
        for field, value in (
            ("dt", 0), ("gain", {"a": 1}), ("gain", policy.gain[:-1]), ("offset", "text"),
            ("nominal", policy.nominal.T), ("state_coordinates", None), ("gain", np.zeros((0, 2, 3))),
        ):  # fmt: skip
            assert refusal(lambda f=field, v=value: dataclasses.replace(policy, **{f: v})).startswith("AffinePolicy: ")
        assert refusal(lambda: lq.AffinePolicy.__call__(policy, np.zeros(3), "soon")).startswith(
            "t: got 'soon', want a finite number >= 0"
        )
        assert policy(np.zeros(3), 1e300).shape == (2,)  # the last law stays in force

    def test_parts_of_several_problems(self, drive_solution: ls.Solution, quadrotor_solution: ls.Solution) -> None:
        for field in ("policy", "trajectory", "cost_to_go", "cost_to_come"):
            other = getattr(quadrotor_solution, field)
            line = refusal(lambda f=field, o=other: dataclasses.replace(drive_solution, **{f: o}))
            assert line.startswith("Solution: ")

    def test_parts_of_several_plans(self, drive_solution: ls.Solution, quadrotor_solution: ls.Solution) -> None:
        """What solutions and re-plans share is checked once, and named by the type that was made."""
        shared = [field.name for field in dataclasses.fields(ls.Plan)]
        plan = ls.Plan(**{name: getattr(drive_solution, name) for name in shared})
        for field in ("policy", "trajectory", "cost_to_go", "goal"):
            other = getattr(quadrotor_solution, field)
            line = refusal(lambda f=field, o=other: dataclasses.replace(plan, **{f: o}))
            assert line.startswith(f"Plan: {'trajectory' if field == 'policy' else field}")

    def test_a_rollout(self, differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
        rollout = ls.simulate(differential_drive.plant(), drive_solution, frames=False)
        for field, value in (
            ("states", rollout.states[:, :-1]), ("clearance", [0.0]), ("radius", "wide"), ("robot", "two\nlines"),
            ("forces", rollout.forces.transpose(0, 2, 1)), ("contacts", [-1]), ("seed", 1.5),
            ("plan", None), ("versions", {"a": 1}), ("disturbances", "wind"), ("body", None), ("goal_radius", 0.0),
            ("goal", [0.0, 1.0]), ("goal", "home"), ("collided_at", [-1.0]), ("collided_at", [np.nan]),
            ("collided_at", [1.0]), ("obstacles", ("pillar",)), ("obstacles", ()), ("obstacles", "pillar"),
            ("diverged_at", [1e6]), ("diverged_at", [0.0, 0.0]), ("failed_at", ["soon"]), ("failed_at", [0.5]),
            ("reasons", (1,)), ("reasons", ("none",)),
        ):  # fmt: skip
            assert refusal(lambda f=field, v=value: dataclasses.replace(rollout, **{f: v})).startswith("Rollout: ")
        for goal in ([np.nan] * 3, [np.inf, 0.0, 0.0]):
            for one in (rollout, drive_solution):
                assert refusal(lambda o=one, g=goal: dataclasses.replace(o, goal=g)).startswith("goal: got ")
        assert refusal(lambda: dataclasses.replace(drive_solution, goal_radius=0.0)).startswith("Solution: goal_radius")
        for field in ("goal_radius", "goal_tolerance"):
            line = refusal(lambda f=field: dataclasses.replace(differential_drive, **{f: "near"}))
            assert line.startswith(f"Scenario: {field}: got 'near'")

    def test_one_that_is_lost_from_the_start_has_a_summary(
        self, differential_drive: ls.Scenario, drive_solution: ls.Solution
    ) -> None:
        rollout = ls.simulate(differential_drive.plant(), drive_solution, frames=False)
        states = np.full_like(rollout.states, np.nan)
        lost = dataclasses.replace(rollout, states=states, diverged_at=np.array([0.0]))
        assert "diverged at once" in lost.summary()

    def test_effects(self, differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
        plant = differential_drive.plant()
        for hook, answer in (
            ("measure", [1.0]), ("measure", "text"), ("actuate", np.zeros((2, 2))), ("force", None),
            ("torque", np.zeros(3)), ("initial_states", np.zeros((1, 4))), ("displaced", np.zeros((1, 2, 3))),
            ("measure", 1j),
        ):  # fmt: skip
            effect = {hook: answer if hook == "displaced" else (lambda *_, answer=answer: answer)}
            line = refusal(lambda e=effect: of_runs.simulate_effect(plant, drive_solution, **e))
            assert line.startswith(f"Hooked: {hook}")
        assert refusal(lambda: ls.disturbances.Effect(force=3)).startswith("Effect: force: got 3, want a function")  # pyright: ignore

    def test_a_list_of_lists_does_for_an_array(
        self, differential_drive: ls.Scenario, drive_solution: ls.Solution
    ) -> None:
        plant = differential_drive.plant()
        as_list = of_runs.simulate_effect(plant, drive_solution, measure=lambda step, states: states.tolist())
        np.testing.assert_array_equal(as_list.states, ls.simulate(plant, drive_solution).states)

    def test_objects_of_the_wrong_kind(self, differential_drive: ls.Scenario, drive_solution: ls.Solution) -> None:
        plant, problem = differential_drive.plant(), differential_drive.problem
        for call in (
            lambda: lq.smooth("problem"), lambda: lq.ilqr([problem]), lambda: lq.simulate(plant, [drive_solution]),
            lambda: lq.simulate("plant", drive_solution), lambda: lq.simulate(plant, drive_solution, controller="none"),
            lambda: lq.Replanner("problem", drive_solution, every=1.0),
            lambda: lq.view.plot_run("solution", {}, "a.png", world=differential_drive.scene.world),
            lambda: lq.report("results", "a.html"), lambda: lq.verify_run("run"),
            lambda: lq.stress.outcomes("run", plant),
            lambda: lq.render("run", "a.mp4"), lambda: lq.Plant("robot", differential_drive.scene),
            lambda: lq.save("solution", "a.npz"), lambda: lq.World(["box"]),
            lambda: lq.disturbances.preset("light", "plant"),
            lambda: lq.smooth(problem, start=lambda: 0), lambda: lq.smooth_many(itertools.repeat(3)),
        ):  # fmt: skip
            assert ": got " in refusal(call)

    def test_names_are_one_short_line(
        self, differential_drive: ls.Scenario, drive_solution: ls.Solution, tmp_path: Path
    ) -> None:
        rollout, world = lq.simulate(differential_drive.plant(), drive_solution), differential_drive.scene.world
        path = tmp_path / "run.png"
        for label in ("x" * 5000, "two\nlines", "", 3):
            call = lambda name=label: lq.view.plot_run(drive_solution, {name: rollout}, path, world=world)  # noqa: E731
            assert refusal(call).startswith("rollouts: a name: got ")
        assert "titles" in refusal(lambda: lq.render(rollout, tmp_path / "a.mp4", titles=["two\nlines"]))
        assert "sweeps: a name" in refusal(lambda: lq.stress.Campaign(scenario="quadrotor", sweeps={"a\nb": ()}))
        lq.view.plot_run(drive_solution, {"a run for $5, or $x^": rollout}, path, world=world)
        assert path.is_file()


class TestFunctions:
    def test_a_cost_of_nothing(self) -> None:
        line = refusal(lambda: ls.FunctionCost(lambda x, u, p: 0.0, depends_on=[]))
        assert line.startswith("FunctionCost: depends_on: got none, want a tuple of names")

    @pytest.mark.parametrize("said", ["math.cos(x[0])", "np.cos(x[0])"])
    def test_functions_of_modules_are_named(self, said: str) -> None:
        value = f"def value(x, u, t, row, data):\n    return {said}\n\n\n"
        slope = "def slope(x, u, t, row, data, gradient):\n    gradient[0] += 1.0\n"
        line = refusal(lambda: ls.types.ConstraintTerm(value + slope, np.zeros(0), 1, str))
        assert line == f"ConstraintTerm: source: got {said[:-6]} in line 2, want cos, without a module"
        term = value.replace("row, ", "") + slope.replace(
            "def slope(x, u, t, row, data, gradient)", "def derivatives(x, u, t, data, hessian, gradient)"
        )
        assert "want cos" in refusal(lambda: CostTerm(term, np.zeros(0)))
        ast.parse(value)

    @pytest.mark.parametrize(
        ("source", "wanted"),
        [
            ("x = 1", "which does not define value(...), want it to"), ("def value(", "which is not valid Python"),
            (3, "got 3, want text"),
            ("def value(x):\n    pass\n", "got value(...) with 1 arguments, want 5"), ("import os\n" * 2, "value"),
        ],
    )  # fmt: skip
    def test_sources_that_are_none(self, source: Any, wanted: str) -> None:
        assert wanted in refusal(lambda: ls.types.ConstraintTerm(source, np.zeros(0), 1, str))

    def test_what_a_function_of_ones_own_raises_is_its_own(self, differential_drive: ls.Scenario) -> None:
        class Mine(Exception):
            pass

        def callback(iteration: ls.types.Iteration) -> None:
            raise Mine

        with pytest.raises(Mine):
            ls.smooth(differential_drive.problem, starts=1, callback=callback)


def enormous(x: Any, u: Any, p: Any) -> list[int]:
    return [10**400]


RECORD: Any = {
    "step": 0, "trial": 0, "status": "converged", "iterations": 3, "seconds": 0.1, "cost": 1.0, "before": 2.0,
    "used": True, "reason": "",
}  # fmt: skip
DEEP: Any = []
for _ in range(3000):
    DEEP = [DEEP]


class Biting:
    """What cannot be looked into."""

    def __iter__(self) -> Any:
        raise TypeError("it bites")


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: dataclasses.replace(ls.load_scene("arena"), geoms=0), "Scene: geoms: got 0, want ids of geoms"),
        (lambda: dataclasses.replace(ls.load_scene("arena"), geoms=(10**200,)), "Scene: geoms: got 1000"),
        (lambda: dataclasses.replace(ls.load_scene("arena"), geoms=(-1,)), "Scene: geoms: got -1, want a whole number"),
        (lambda: dataclasses.replace(ls.load_scene("arena"), geoms=(0, 0)), "Scene: geoms: got (0, 0), want different"),
        (lambda: dataclasses.replace(rate(1, 2), value=[1.0]), "Estimate: value: got [1.0]"),
        (lambda: lq.MjcfRobot("cage", position=Biting()), "MjcfRobot cage: position: got "),
        (lambda: lq.verify_video("it.mp4", np.eye(3)), "rollout: got array"),
        (lambda: Campaign.of_sets(("plan",), ("light",)), "scenario: got ('plan',), want a"),  # pyright: ignore
        *[
            (
                lambda key=key, it=it: Campaign.of_sets("quadrotor", **{"sets": ("light",), key: it}),
                f"{key}[0]: got 1, want text" if it == (1,) else f"{key}: got ",
            )
            for key in ("sets", "policies")
            for it in (Biting(), 3, "light", (1,), None)
        ],
        (
            lambda: ls.check_derivatives(lq.Dynamics(enormous, states={"x": "m"}, controls={"u": "N"}, level="plain")),
            "enormous(x, u, p): got ",
        ),
        (lambda: Uncertainty(model_error=DEEP), "Uncertainty: model_error: got "),
        (
            lambda: Uncertainty(start={"m": -1.0}),
            "Uncertainty: start: 'm': got -1.0, want a finite number >= 0",
        ),
        (lambda: ls.rotations.vector_rate((1e300, 1e300, 1e300), (0.0, 0.0, 1.0)), "r: got a rotation vector whose"),
        (lambda: ls.rotations.rotate((0.0, 0.0, 10**400), (0.0, 0.0, 1.0)), "r: got "),
        (lambda: ls.rotations.vector_rate((0.0, 0.0, 1.0), (0.0, 0.0, 10**400)), "w: got "),
        (lambda: lq.SiteCost("tip", position=np.zeros(3), weight=[[1.0, 2.0], [3.0]]), "SiteCost: weight: got "),
        (lambda: lq.types.Capsule(0.4, 0.1, 0.02).between((0, 0, 0), itertools.count()), "between: got "),
        (lambda: ls.stress.FunnelCheck(0, DEEP, rate(1, 2), np.ones(2, dtype=bool)), "FunnelCheck: level: got "),
        (lambda: ls.stress.ComparedPlan("", DEEP, np.ones(2, dtype=bool)), "ComparedPlan: solution: got "),
        (lambda: ls.types.ReplanRecord(**RECORD | {"reason": DEEP}), "ReplanRecord: reason: got "),
        *(
            (lambda kind=kind, shapes=shapes: kind(*map(np.ones, shapes)), f"{kind.__name__}: {name}: got shape")
            for kind, second in ((ls.types.Quadratic, "gradient"), (ls.types.Moments, "mean"))
            for name, shapes in (
                (second, ((5, 3, 3), (5, 3, 3), (5,))),
                (second, ((5, 3, 3), (3,), (5,))),
                (second, ((3, 3), (5, 3), (5,))),
                ("constant", ((5, 3, 3), (5, 3), (5, 3))),
                ("constant", ((3, 3), (3,), (5,))),
            )
        ),
        (lambda: lq.disturbances.Effect(factors=["mass"]), "Effect: factors: got ['mass'], want factors by name"),
        (lambda: lq.disturbances.Effect(factors=3), "Effect: factors: got 3, want factors by name"),
        (lambda: lq.disturbances.Effect(factors={"mas": 1}), "Effect: factors: got 'mas', want one of: mass"),
    ],
)
def test_what_hostile_calls_once_found(call: Callable[[], object], says: str) -> None:
    assert refusal(call).startswith(says)


@pytest.mark.parametrize(
    ("robot", "positions", "velocities"),
    [(ls.DifferentialDrive, 9, 8), (ls.Quadrotor, 7, 6), (lambda: ls.MjcfRobot("cage"), 7, 6)],
)
def test_positions_and_velocities_are_of_as_many_states(robot: Any, positions: int, velocities: int) -> None:
    line = refusal(lambda: robot().state(np.zeros((2, positions)), np.zeros(velocities)))
    assert line == f"qvel: got shape ({velocities},), want qpos's shape, (2, {positions}), with {velocities} numbers"


def test_a_robot_at_rest_has_a_state() -> None:
    """A single configuration, not a batch of them, of a quadrotor that is not turned."""
    robot = ls.Quadrotor()
    np.testing.assert_array_equal(robot.state(*robot.configuration(np.zeros(12))), np.zeros(12))


@pytest.mark.parametrize("robot", [ls.Quadrotor, ls.DifferentialDrive])
def test_robots_have_lengths_and_masses(robot: type) -> None:
    for field in dataclasses.fields(robot):
        for value in (-1.0, math.nan, "heavy"):
            assert refusal(lambda f=field, v=value: robot(**{f.name: v})).startswith(
                f"{robot.__name__}: {field.name}: got "
            )
