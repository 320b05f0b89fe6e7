"""Policies in files of their own: what runs elsewhere is what runs here, and what is spoilt gets one line."""

import contextlib
import json
import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from linear_plans import DT, double_integrator, law_of, linear
from sampling import rarely
from spoiling import content_hash, contents, rewrite

import lqrsim as ls
from lqrsim.control.controllers import OutputFeedback
from lqrsim.disturbances import Uncertainty, Unknown
from lqrsim.errors import Array

same = import_module("robustness.files").same

PAGE = Path(__file__).parent.parent / "docs" / "file_format.md"
SECTION = re.compile(r"^## A policy with its filter.*?^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PASSING = Unknown("d0", 0.5, time_constant=0.4, order=2)


def page() -> dict[str, Any]:
    """The lines of docs/file_format.md that run a policy with its filter; policy.npz is in the working directory."""
    found = SECTION.search(PAGE.read_text(encoding="utf-8"))
    assert found is not None
    code, names = found.group(1), {"np": np, "json": json}
    function = code.split("def step")[1].strip().splitlines()
    assert len(function) <= 11
    exec(compile(code, str(PAGE), "exec"), names)
    return names


@pytest.fixture
def law() -> ls.OffsetFree:
    return law_of(double_integrator(controls=np.ones((12, 1)), limits=(-2.0, 2.0)))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {
            "lag": 0.07,
            "unknowns": (Unknown("d0", 0.3), PASSING, Unknown("offset of u0", 0.2)),
        },
        {"sensors": [[1.0, 0.5], [0.0, 2.0], [1.0, 1.0]]},
        {"latency": 3, "delay": 2, "sensors": ("s1", "s0")},
        *rarely({"sensors": ("s0",)}, {"latency": 2}, {"delay": 3, "lag": 0.05}),
    ],
    ids=str,
)
def test_class_page_and_compiled_controller_agree_on_a_linear_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any]
) -> None:
    """The ten lines of the page, the class from its file, and the compiled controller, to 1e-9; limits act."""
    monkeypatch.chdir(tmp_path)
    steps, rng = 25, np.random.default_rng(0)
    system = double_integrator(
        start=[1.0, 0.0], controls=0.5 * np.sin(np.arange(steps) / 4)[:, None], limits=(-1.5, 1.5)
    )
    law = law_of(system, **options)
    policy = ls.load(ls.save(law.policy, "policy.npz"))
    assert isinstance(policy, ls.types.OutputFeedbackPolicy)
    names, control = page(), law.start(1).control
    elsewhere, z, found = names["z"], policy.start(), []
    sensors = options.get("sensors")
    chosen = np.eye(2) if sensors is None else np.array(
        [[float(one == f"s{i}") for i in (0, 1)] if isinstance(one, str) else one for one in sensors]
    )  # fmt: skip
    for t in range(steps):
        shown = system.plan.states[t] + 0.2 * rng.normal(size=2)
        y = chosen @ shown
        here = control(t, shown[None])[0]
        u, z = policy.step(z, y, t * DT)
        there, elsewhere = names["step"](elsewhere, y, t * DT)
        np.testing.assert_allclose(u, here, rtol=0, atol=1e-9)
        np.testing.assert_allclose(there, here, rtol=0, atol=1e-9)
        found.append(u[0])
    assert np.abs(found).max() == 1.5
    assert np.abs(found).min() < 1.5


@pytest.mark.parametrize("latency", [0, 1, 3, 20])
@pytest.mark.parametrize("options", [{}, {"delay": 2}, {"start": 0.0}, {"lag": 0.07, "sensors": ("s1",)}], ids=str)
def test_a_run_of_the_policy_takes_late_and_lost_measurements_as_its_law_does(
    latency: int, options: dict[str, Any]
) -> None:
    """The first one is repeated until it arrives, and each that gets lost is NaN."""
    rng = np.random.default_rng(0)
    system = double_integrator(start=[1.0, 0.0], controls=np.ones((12, 1)), limits=(-2.0, 2.0))
    stated: dict[str, Any] = {"latency": latency} | options
    law = law_of(system, **stated)
    runs = [controller.start(2) for controller in (law, OutputFeedback(law.policy))]
    shown = system.plan.states[0] + 0.2 * rng.normal(size=(2, 2))
    for t in range(12):
        if t > latency:
            arrives = rng.random(2) < 0.6
            shown[~arrives] = np.nan
            shown[arrives] = system.plan.states[t - latency] + 0.2 * rng.normal(size=(int(arrives.sum()), 2))
        of_law, of_policy = (run.control(t, shown.copy()) for run in runs)
        np.testing.assert_allclose(of_policy, of_law, rtol=0, atol=1e-9)


@pytest.mark.parametrize("shown", [1e308, -1.7e308])
@pytest.mark.parametrize("options", [{}, {"delay": 2}, {"latency": 1}, {"lag": 0.07}], ids=str)
def test_a_filter_that_diverges_ends_its_own_trial_alone(shown: float, options: dict[str, Any]) -> None:
    system = double_integrator(start=[1.0, 0.0], controls=np.ones((12, 1)), limits=(-2.0, 2.0))
    controller = OutputFeedback(law_of(system, **options).policy)
    together, alone = controller.start(2), controller.start(1)
    for t in range(12):
        usual, sign = system.plan.states[[t]] + 0.1 * np.sin(t), 1.0 if t % 2 else -1.0
        commands = together.control(t, np.concatenate([usual, [[sign * shown, shown]]]))
        np.testing.assert_array_equal(commands[:1], alone.control(t, usual))
    assert together.estimator_diverged() == {1: "the state of the filter is not finite"}
    assert alone.estimator_diverged() == {}


def test_angles_are_taken_nearest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements of the differential drive with whole turns added: not a digit that counts is another."""
    monkeypatch.chdir(tmp_path)
    scenario = ls.scenarios.differential_drive()
    solution = ls.smooth(scenario.problem)
    uncertainty = Uncertainty(measurement=0.01, start=0.01, control=0.01)
    law = ls.OffsetFree(scenario.problem, solution, uncertainty, tolerate={"m": 0.05, "rad": 0.1})
    policy = law.policy
    ls.save(policy, "policy.npz")
    names, rng, plan = page(), np.random.default_rng(0), solution.trajectory
    z, turned, elsewhere = policy.start(), policy.start(), names["z"]
    assert plan.states[:, 2].max() - plan.states[:, 2].min() > 1.0
    for t in range(60):
        y = plan.states[t] + 0.01 * rng.normal(size=3)
        more = y + 2 * np.pi * rng.integers(-2, 3) * np.array([0.0, 0.0, 1.0])
        u, z = policy.step(z, y, t * plan.dt)
        again, turned = policy.step(turned, more, t * plan.dt)
        there, elsewhere = names["step"](elsewhere, more, t * plan.dt)
        np.testing.assert_allclose(again, u, rtol=0, atol=1e-9)
        np.testing.assert_allclose(there, u, rtol=0, atol=1e-9)


def test_a_lost_measurement_is_predicted(law: ls.OffsetFree) -> None:
    policy, control = law.policy, law.start(1).control
    z, shown = policy.start(), np.array([0.2, -0.1])
    for t in range(6):
        lost = t in (2, 3)
        shown = shown + 0.1
        u, z = policy.step(z, None if lost else shown, t * DT)
        seen = np.full((1, 2), np.nan) if lost else shown[None]
        np.testing.assert_allclose(u, control(t, seen)[0], rtol=0, atol=1e-9)
    many, _ = policy.step(np.tile(z, (3, 2, 1)), np.zeros((3, 2, 2)), 0.6)
    np.testing.assert_allclose(many, np.broadcast_to(policy.step(z, np.zeros(2), 0.6)[0], (3, 2, 1)), atol=1e-12)


def flown(quadrotor: ls.Scenario, solution: ls.Solution, law: ls.OffsetFree) -> tuple[ls.Rollout, Array]:
    """A flight in light disturbances with the compiled controller, and what its policy commands of the same."""
    plant = quadrotor.plant()
    rollout = ls.simulate(plant, solution, controller=law, disturbances=ls.disturbances.preset("light", plant), seed=1)
    policy, commands = law.policy, []
    z, last = policy.start(), solution.trajectory.states[0]
    for t, shown in enumerate(rollout.measured[0, :-1]):
        u, z = policy.step(z, None if (shown == last).all() else shown, t * policy.dt)
        last = shown
        commands.append(u)
    return rollout, np.array(commands)


def test_on_the_quadrotor_they_are_close(quadrotor: ls.Scenario, quadrotor_solution: ls.Solution) -> None:
    """In the preset light, of the same measurements: 2 % of the rotors' range in the mean; one predicts linearly."""
    unknowns = [Unknown(f"wind_{axis}", 0.5, time_constant=1.0) for axis in "xyz"]
    unknowns += [Unknown("mass", 0.01)] + [Unknown(f"gain of rotor_{i}", 0.04) for i in (1, 2, 3, 4)]
    measured = {"m": 5e-3, "m/s": 5e-2, "rad": 5e-3, "rad/s": 5e-3}
    uncertainty = Uncertainty(unknowns=unknowns, start=0.01, measurement=measured, control=0.037, lag=0.024)
    law = ls.OffsetFree(
        quadrotor.problem, quadrotor_solution, uncertainty,
        tolerate={"m": 0.1, "m/s": 0.5, "rad": 0.3, "rad/s": 2.0},
    )  # fmt: skip
    rollout, commands = flown(quadrotor, quadrotor_solution, law)
    assert rollout.outcome == ("reached",)
    apart = np.abs(commands - rollout.commanded[0])

    assert apart.mean() < 0.02 * ls.Quadrotor().max_force


# Files.


@pytest.fixture
def saved(tmp_path: Path, law: ls.OffsetFree) -> Path:
    return ls.save(law.policy, tmp_path / "policy.npz")


def test_policies_survive(saved: Path, law: ls.OffsetFree, tmp_path: Path, drive_solution: ls.Solution) -> None:
    assert same(ls.load(saved), law.policy)
    assert ls.save(law.policy, tmp_path / "again.npz").read_bytes() == saved.read_bytes()
    affine = ls.load(ls.save(drive_solution.policy, tmp_path / "affine.npz"), ls.AffinePolicy)
    assert same(affine, drive_solution.policy)
    assert affine.digest == drive_solution.policy.digest


def test_digests_differ_where_controls_do(law: ls.OffsetFree) -> None:
    """Limits, and for output feedback also which states are measured."""
    policy = law.policy
    controls, measured = policy.control_coordinates, policy.measured_coordinates
    others = [
        policy,
        replace(policy, control_coordinates=controls.limited((0.0, 0.1))),
        replace(policy, measured_coordinates=replace(measured, names=measured.names[::-1])),
        replace(policy, measured_coordinates=replace(measured, units=("",) * len(measured), angles=(0,), position=())),
    ]
    assert len({one.digest for one in others}) == 4
    same = controls.limited((controls.low, controls.high))
    assert replace(policy, control_coordinates=same).digest == policy.digest


def test_the_hash_is_what_the_page_says(saved: Path) -> None:
    arrays, meta = contents(saved)
    assert meta["sha256"] == content_hash(arrays, meta)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 2}, "of version 2, want version 1"),
        ({"format": "lqrsim solution"}, "holds a 'lqrsim solution', want a 'lqrsim output feedback policy'"),
        ({"measured_coordinates": 3}, "measured_coordinates: got 3, want an object"),
        ({"measured_coordinates": None}, "measured_coordinates: got None, want an object"),
        (
            {"measured_coordinates": lambda one: one | {"names": ["a"], "units": [""], "low": [], "high": []}},
            r"correction: got shape \(12, 3, 2\), want \(T, Z, Y\) = \(12, 3, 1\)",
        ),
        ({"dt": -1.0}, "dt: got -1.0"),
        ({"more": 1}, "meta: got 'more', want only"),
        ({"gain": None}, "gain: got nothing, want this field"),
        ({"bomb": np.zeros(2)}, "'bomb': got an unknown array, want only arrays of this format"),
        ({"gain": lambda a: a[:-1].copy()}, "got shape"),
        ({"gain": lambda a: a.astype(int)}, "gain: got numbers of type <i8, want <f8"),
        ({"gain": lambda a: a * np.nan}, r"gain\[0, 0, 0\]: got nan, want a finite number"),
        ({"drift": lambda a: a + np.inf}, r"drift\[0, 0\]: got inf, want a finite number"),
        ({"nominal": lambda a: a + np.inf}, r"nominal\[0, 0\]: got inf"),
        ({"transition": lambda a: a[:, :-1].copy()}, "transition: got shape"),
        ({"sensor": lambda a: a[..., :1].copy()}, "sensor: got shape"),
        ({"control_coordinates": lambda one: one | {"low": [5.0]}}, "limits of u0: got 5 to 2"),
    ],
)
def test_a_spoilt_policy_gets_one_line(saved: Path, changes: dict[str, Any], message: str) -> None:
    rewrite(saved, **changes)
    with pytest.raises(ls.InputError, match=message):
        ls.load(saved, ls.types.OutputFeedbackPolicy)


def test_a_smaller_state_than_the_robots_is_refused(saved: Path) -> None:
    cut = {"gain": lambda a: a[..., :1], "correction": lambda a: a[:, :1], "transition": lambda a: a[:, :1, :1]}
    cut |= {"input": lambda a: a[:, :1], "drift": lambda a: a[:, :1], "nominal": lambda a: a[:, :1]}
    rewrite(saved, **{name: (lambda a, part=part: part(a).copy()) for name, part in cut.items()})
    with pytest.raises(ls.InputError, match=r"nominal: got shape \(12, 1\), want at least one row, of 2 states"):
        ls.load(saved, ls.types.OutputFeedbackPolicy)


def test_every_flipped_bit_is_harmless(saved: Path, law: ls.OffsetFree) -> None:
    original, policy, rng = saved.read_bytes(), law.policy, np.random.default_rng(0)
    for place in rng.integers(len(original), size=100):
        spoilt = bytearray(original)
        spoilt[place] ^= 1 << int(rng.integers(8))
        saved.write_bytes(bytes(spoilt))
        with contextlib.suppress(ls.InputError):
            assert same(ls.load(saved), policy)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((np.zeros(2), np.zeros(2), 0.0), "z: got shape (2,), want (..., 3)"),
        ((np.full(3, np.nan), np.zeros(2), 0.0), "z: got"),
        ((np.zeros(3), np.zeros(3), 0.0), "measurement: got shape (3,), want (..., 2)"),
        ((np.zeros(3), [0.0, np.inf], 0.0), "measurement: got"),
        ((np.zeros(3), "none", 0.0), "measurement: got 'none'"),
        ((np.zeros(3), np.zeros(2), -1.0), "t: got -1"),
        ((np.zeros(3), np.zeros(2), np.nan), "t: got nan"),
    ],
)
def test_what_is_no_measurement_is_refused(law: ls.OffsetFree, arguments: Any, says: str) -> None:
    with pytest.raises(ls.InputError) as caught:
        law.policy.step(*arguments)
    assert str(caught.value).startswith(says)


def test_a_policy_that_was_made_by_hand_is_checked(law: ls.OffsetFree, tmp_path: Path) -> None:
    with pytest.raises(
        ls.InputError, match=r"OutputFeedbackPolicy: input: got shape \(12, 3\), want \(T, Z, m\) = \(12, 3, 1\)"
    ):
        replace(law.policy, input=np.zeros((12, 3)))
    with pytest.raises(ls.InputError, match=r"OutputFeedbackPolicy: drift\[0, 0\]: got nan, want"):
        replace(law.policy, drift=np.full((12, 3), np.nan))
    other = linear([[0.0]], [[1.0]], [[1.0]], steps=3).solution.policy
    with pytest.raises(ls.InputError, match=r"policy: got .*, which holds a 'lqrsim solution'"):
        ls.load(ls.save(double_integrator(steps=3).solution, tmp_path / "solution.npz"), ls.AffinePolicy)
    with pytest.raises(ls.InputError, match=r"solution: got .*, which holds a 'lqrsim policy'"):
        ls.load(ls.save(other, tmp_path / "policy.npz"), ls.Solution)
