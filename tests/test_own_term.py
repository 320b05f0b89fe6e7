"""A kind of cost that a user writes, class and kernel in one file, goes wherever those of the package go."""

import importlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from huber_distance import HuberDistance
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from sampling import examples

import lqrsim as ls
from lqrsim.codegen.compiled_module import module_of
from lqrsim.codegen.plain import plain_functions
from lqrsim.codegen.sources import source_of
from lqrsim.solvers.multistart import passable
from lqrsim.view.viewer import MovableGoal

PLACE, WEIGHT, WIDTH = {"x": 1.5, "y": 1.0}, 8.0, 0.4
WORLD = ls.World([ls.Obstacle("ball", "sphere", np.array([0.8, 0.45, 0.0]), np.eye(3), np.array([0.2, 0.0, 0.0]))])


def mass(x: Any, u: Any, p: Any) -> list[Any]:
    return [x.vx, x.vy, u.ax - 0.1 * x.vx * x.vy, u.ay]


MASS = ls.Dynamics(
    mass, states={"vx": "m/s", "x": "m", "vy": "m/s", "y": "m"}, controls={"ax": "m/s^2", "ay": "m/s^2"},
    position=("x", "y"),
)  # fmt: skip


def formula(x: Any, u: Any, p: Any) -> Any:
    """The same cost, with SymPy's derivatives."""
    import sympy

    r = sympy.sqrt((x.x - PLACE["x"]) ** 2 + (x.y - PLACE["y"]) ** 2)
    return WEIGHT * sympy.Piecewise((r**2 / 2, r <= WIDTH), (WIDTH * (r - WIDTH / 2), True))


def stated(cost: ls.Cost, **options: Any) -> ls.Problem:
    slow = ls.QuadraticCost({"m/s": 0.5}, about={"x": 0.0})
    return ls.Problem(
        dynamics=MASS, dt=0.1, steps=30, initial=ls.FixedState(x=0.0), stage_cost=cost + slow + ls.ControlCost([1, 1]),
        final_cost=cost, **options,
    )  # fmt: skip


OWN, SYMBOLIC = HuberDistance(PLACE, WEIGHT, WIDTH), ls.SymbolicCost(formula, convex=True)


def test_it_is_one_short_file_which_a_page_shows() -> None:
    tests = Path(__file__).parent
    text = (tests / "helpers" / "huber_distance.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    assert f"```py\n{text}```\n" in (tests.parent / "docs" / "stating_a_system.md").read_text(encoding="utf-8")


def test_its_value_and_derivatives() -> None:
    """Compiled, against a formula by hand and central differences, which round and cut off 1e-9 of numbers of 10."""
    term, rng = OWN.bind(MASS), np.random.default_rng(0)
    module = module_of(term.code, "Huber", N=4, M=2)
    plain = plain_functions(term.code, {"N": 4, "M": 2}, ["value", "derivatives"])

    def cost(x: np.ndarray) -> float:
        return module.value(x, np.zeros(2), 1, term.data)

    def slopes(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        assert module.derivatives(x, np.zeros(2), 1, term.data, hessian, gradient) == pytest.approx(cost(x), rel=1e-14)
        return gradient, hessian

    for spread in (0.1, 0.1, 2.0, 2.0, 2.0):  # near and far
        x = np.array([0.0, PLACE["x"], 0.0, PLACE["y"]]) + spread * rng.normal(size=4)
        r = np.hypot(x[1] - PLACE["x"], x[3] - PLACE["y"])
        by_hand = WEIGHT * (r**2 / 2 if r <= WIDTH else WIDTH * (r - WIDTH / 2))
        assert cost(x) == pytest.approx(by_hand, rel=1e-14)
        assert plain["value"](x, np.zeros(2), 1, term.data) == pytest.approx(by_hand, rel=1e-14)
        gradient, hessian = slopes(x)
        for i in range(4):
            step = 1e-5 * np.eye(4)[i]
            assert gradient[i] == pytest.approx((cost(x + step) - cost(x - step)) / 2e-5, abs=1e-8)
            difference = (slopes(x + step)[0] - slopes(x - step)[0]) / 2e-5
            np.testing.assert_allclose(hessian[i], difference, rtol=0, atol=1e-7)
    assert (hessian[[0, 2, 4, 5]] == 0).all()
    assert all(check.good for check in ls.check_derivatives(stated(OWN), spread=1.0))


CONSTRAINTS = {
    "none": [], "clear": [ls.Clearance(WORLD, radius=0.1)],
    "bounds and goal": [ls.StateBounds({"m/s": (-1.0, 0.7)}), ls.GoalState(vx=0.0, vy=0.0)],
}  # fmt: skip


@pytest.mark.parametrize("kept", CONSTRAINTS)
def test_it_has_the_optimum_of_the_same_formula(kept: str) -> None:
    """Both optima have an optimality of 1e-8, relative to costs of 40."""
    own, symbolic = (ls.smooth(stated(cost, constraints=CONSTRAINTS[kept])) for cost in (OWN, SYMBOLIC))
    assert own.success, own.detail
    assert own.cost == pytest.approx(symbolic.cost, rel=1e-8)
    np.testing.assert_allclose(own.trajectory.states, symbolic.trajectory.states, rtol=0, atol=1e-5)
    if kept == "none":
        assert ls.ilqr(stated(OWN)).cost == pytest.approx(own.cost, rel=1e-8)
    again = ls.smooth_many([stated(OWN, constraints=CONSTRAINTS[kept])])[0]
    np.testing.assert_array_equal(again.trajectory.controls, own.trajectory.controls)


def test_solutions_are_saved_and_loaded(tmp_path: Path) -> None:
    solution = ls.smooth(stated(OWN))
    loaded = ls.load(ls.save(solution, tmp_path / "own.npz"), ls.Solution)
    assert loaded.problem_digest == solution.problem_digest == stated(OWN).digest
    assert loaded.problem_digest != stated(replace(OWN, width=0.5)).digest
    np.testing.assert_array_equal(loaded.policy.gain, solution.policy.gain)


def test_it_names_a_goal_which_can_be_moved_and_weighed() -> None:
    problem = stated(OWN)
    np.testing.assert_array_equal(problem.weighed_goal, [np.nan, 1.5, np.nan, 1.0])
    moved = replace(problem, final_cost=MovableGoal(problem).cost_at(np.array([2.0, 0.5])))
    np.testing.assert_array_equal(moved.weighed_goal, [np.nan, 2.0, np.nan, 0.5])
    around = ls.smooth(stated(OWN + ls.ObstacleCost(WORLD, radius=0.1)))  # by the search, which has paths to the goal
    assert around.success
    assert len(around.candidates) > 1


def test_it_goes_with_a_free_duration() -> None:
    free = stated(OWN, duration=(1.0, 9.0), time_weight=3.0)
    own, symbolic = ls.smooth(free), ls.smooth(stated(SYMBOLIC, duration=(1.0, 9.0), time_weight=3.0))
    assert own.success, own.detail
    assert own.trajectory.horizon == pytest.approx(symbolic.trajectory.horizon, rel=1e-6)


def test_costs_that_cannot_have_another_state_say_so() -> None:
    def function(x: Any, u: Any, p: Any) -> float:
        return x[0] ** 2

    own = ls.FunctionCost(function, depends_on=("vx",))
    with pytest.raises(ls.InputError, match="duration and control_rate: got a FunctionCost beside"):
        ls.smooth(stated(OWN + own, duration=(1.0, 9.0)))


class Half(ls.Constraint):
    """x <= 2, said to be a convex set or not."""

    def __init__(self, convex: bool) -> None:
        self.convex = convex

    def bind(self, dynamics: ls.Dynamics) -> ls.types.ConstraintTerm:
        value = "def value(x, u, t, row, data):\n    return data[0] - x[1]\n\n\n"
        slope = "def slope(x, u, t, row, data, gradient):\n    gradient[1] -= 1.0\n"
        return ls.types.ConstraintTerm(value + slope, np.array([2.0]), 1, str, convex=self.convex)


def test_no_way_is_sought_round_convex_sets() -> None:
    kept = [Half(True), Half(False), ls.Clearance(WORLD, radius=0.1), ls.StateBounds(x=(-1.0, 9.0))]
    assert passable(stated(OWN, constraints=kept)) == [False, True, True, False]


def test_what_else_a_file_says_is_no_part_of_the_problem(tmp_path: Path) -> None:
    """Only its kernels and their numbers are: a script may change around them, and nothing is compiled again."""
    first = "from lqrsim.codegen.sources import source_of"
    kernel = "SIZE = {}\n\n\ndef value(x, u, t, data):\n    return SIZE * x[0]\n"
    digests = []
    for number, before in ((2, first), (2, f"# changed\n{first}\nOTHER = 1"), (3, first)):
        text = f"{before}\n{kernel.format(number)}\nprint(source_of(__name__).digest)\n"
        (tmp_path / "own.py").write_text(text, encoding="utf-8")
        done = subprocess.run([sys.executable, "own.py"], cwd=tmp_path, capture_output=True, text=True, check=True)
        digests.append(done.stdout)
    assert digests[0] == digests[1] != digests[2]


OWN_KERNEL = "SCALE = {}\n\n\ndef value(x, u, t, data):\n    return {}\n"
FORMULAS = "SCALE * x[0]", "SCALE - x[0]", ""


@settings(max_examples=examples(5), phases=[Phase.explicit, Phase.generate])
@given(st.lists(st.tuples(st.integers(1, 9), st.sampled_from(FORMULAS)), min_size=2, max_size=5))
@example([(2, FORMULAS[0]), (3, FORMULAS[1]), (4, "")])
def test_a_file_that_changes_has_its_new_kernels_and_numbers(changes: list[tuple[int, str]]) -> None:
    """As in a notebook, where a file is edited and loaded again; or, without a formula, its number is set."""
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setattr(sys, "dont_write_bytecode", True)  # Python tells versions of a file apart by size and second
        Path(folder, "changing.py").write_text(OWN_KERNEL.format(1, written := FORMULAS[0]), encoding="utf-8")
        own = importlib.import_module("changing")
        for scale, new in changes:
            if new:
                written = new
                Path(folder, "changing.py").write_text(OWN_KERNEL.format(scale, new), encoding="utf-8")
                importlib.reload(own)
            vars(own)["SCALE"] = scale
            source, wanted = source_of(own), eval(written, {"SCALE": scale, "x": [2.0]})
            compiled = module_of(source, "a file that changes", N=1, M=1).value
            for value in (plain_functions(source, {"N": 1, "M": 1}, ["value"])["value"], compiled):
                assert value(np.array([2.0]), np.zeros(1), 0, np.zeros(0)) == wanted
        del sys.modules["changing"]
