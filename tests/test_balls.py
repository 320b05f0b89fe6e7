"""Robots that are several balls: costs and clearances of all of them, capsules, and what is refused."""

import dataclasses
import pickle
from pathlib import Path
from typing import Any

import mujoco
import numba
import numpy as np
import point_mass
import pytest
from planar_arm import LENGTH, LINK, PlanarArm, places
from sampling import rarely

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.problem.derivative_check import evaluate
from lqrsim.solvers import compiled

ARM = PlanarArm()
STATES = ARM.dynamics.state_coordinates.names
TURNED = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
WORLD = ls.World(
    [
        ls.Obstacle("ball", "sphere", np.array([0.5, 0.5, 0.2]), np.eye(3), np.array([0.1, 0.0, 0.0])),
        ls.Obstacle("post", "capsule", np.array([0.9, -0.3, 0.1]), TURNED, np.array([0.05, 0.2, 0.0])),
        ls.Obstacle("crate", "box", np.array([-0.6, 0.2, 0.1]), TURNED, np.array([0.1, 0.2, 0.05])),
    ]
)
SHARPNESS, WEIGHT = 6.0, 0.7
SHARE = 2.0 / (LINK.count - 1)  # of the second link, where the second of the three is


def three(x, p):
    """Some balls of the arm: of other sizes, and one that does not move."""
    chain = places(x, p)
    return [chain[0], chain[LINK.count + 2], chain[-1]]


def three_numbers(x, p):
    a, ab, abc = x[0], x[0] + x[1], x[0] + x[1] + x[2]
    elbow = p.length * np.array([np.cos(a), np.sin(a), 0.0])
    out = np.zeros((3, 3))
    out[:, 2] = 0.1
    out[1] += elbow + SHARE * p.length * np.array([np.cos(ab), np.sin(ab), 0.0])
    out[2] += elbow + p.length * np.array([np.cos(ab) + np.cos(abc), np.sin(ab) + np.sin(abc), 0.0])
    return out


balls_of: Any = ls.CollisionSpheres  # whose types nobody checks
RADII = (0.02, 0.05, 0.08)
THREE = ls.CollisionSpheres(three, RADII)


def draw(seed: int) -> Array:
    return np.random.default_rng(seed).normal(scale=0.8, size=len(STATES))


def in_numpy(state: Array) -> Array:
    """Where the three are, by hand."""

    class P:
        length = LENGTH

    return three_numbers(state, P)


class TestCost:
    def test_it_is_the_sum_over_balls_and_obstacles(self) -> None:
        term = ls.ObstacleCost(WORLD, balls=THREE, sharpness=SHARPNESS, weight=WEIGHT).bind(ARM.dynamics)
        for seed in range(5):
            state = draw(seed)
            away = np.array([WORLD.distances(place) for place in in_numpy(state)]) - np.array(RADII)[:, None]
            wanted = WEIGHT * np.exp(-SHARPNESS * away).sum()
            assert evaluate(term, state, np.zeros(3))[0] == pytest.approx(wanted, rel=1e-12)

    def test_gradient_and_hessian(self) -> None:
        """The gradient by differences; the Hessian is that in the places, by differences there, and their slopes."""
        term = ls.ObstacleCost(WORLD, balls=THREE, sharpness=SHARPNESS, weight=WEIGHT).bind(ARM.dynamics)

        def cost(at: Array) -> float:
            away = np.array([WORLD.distances(place) for place in at.reshape(3, 3)]) - np.array(RADII)[:, None]
            return float(WEIGHT * np.exp(-SHARPNESS * away).sum())

        for seed in range(5):
            state = draw(seed)
            _, gradient, hessian = evaluate(term, state, np.zeros(3))
            moves = 1e-6 * np.eye(len(state))
            slope = [(cost(in_numpy(state + d)) - cost(in_numpy(state - d))) / 2e-6 for d in moves]
            np.testing.assert_allclose(gradient[:6], slope, rtol=1e-6, atol=1e-7)
            at, steps = in_numpy(state).ravel(), 1e-4 * np.eye(9)
            curve = np.array(
                [
                    [(cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b)) / 4e-8 for a in steps]
                    for b in steps
                ]
            )
            jacobian = np.stack([(in_numpy(state + d) - in_numpy(state - d)).ravel() / 2e-6 for d in moves], axis=1)
            wanted = jacobian.T @ curve @ jacobian
            np.testing.assert_allclose(hessian[:6, :6], wanted, atol=1e-4 * np.abs(wanted).max())
            assert not gradient[6:].any()
            assert not hessian[6:].any()

    def test_the_states_it_is_not_convex_in_are_those_that_move_a_ball(self) -> None:
        assert ls.ObstacleCost(WORLD, balls=THREE).bind(ARM.dynamics).nonconvex_in == (0, 1, 2)


@pytest.mark.parametrize("margin", [0.01, np.linspace(0, 0.1, 4), 0.01 * np.arange(12.0).reshape(4, 3)])
def test_clearance(margin: Any) -> None:
    """Its rows, their slopes, and what each is called; compiled, too."""
    kept = ls.Clearance(WORLD, balls=THREE, margin=margin)
    problem = ls.Problem(
        dynamics=ARM.dynamics, dt=0.05, steps=3, initial=ls.QuadraticCost(np.ones(6), about=np.zeros(6)),
        stage_cost=ls.ControlCost(np.ones(3)), final_cost=ls.QuadraticCost(np.ones(6), about=np.zeros(6)),
        constraints=[kept],
    )  # fmt: skip
    (term,) = problem.constraint_terms
    assert term.rows == 9
    assert "'ball 2' to obstacle 'crate'" in term.describe(8)
    assert "'ball 0' to obstacle 'post'" in term.describe(1)
    margins = np.broadcast_to(np.reshape(margin, (-1, 1)) if np.ndim(margin) < 2 else margin, (4, 3))
    states, controls = np.array([draw(seed) for seed in range(4)]), np.zeros((3, 3))
    wanted = [
        [WORLD.distances(place) - radius - margins[t] for place, radius in zip(in_numpy(state), RADII, strict=True)]
        for t, state in enumerate(states)
    ]
    costs, constraints = compiled.costs_module(problem), compiled.compile_problem(problem).stage.constraints
    values = (np.empty(36),)
    costs.evaluate_constraints(3, states, controls, constraints, values)
    np.testing.assert_allclose(values[0], np.ravel(wanted), rtol=0, atol=1e-12)
    for row in range(9):
        slope, ball, obstacle = np.zeros(9), row // 3, row % 3
        costs.slope_of_constraint(0, row, states[1], controls[0], 1, constraints, slope)
        ahead, behind = (
            [WORLD.distances(in_numpy(states[1] + side * d)[ball])[obstacle] for d in 1e-6 * np.eye(6)]
            for side in (1, -1)
        )
        np.testing.assert_allclose(slope[:6], (np.array(ahead) - behind) / 2e-6, rtol=0, atol=1e-8)
        assert not slope[6:].any()


@pytest.fixture(scope="module")
def pair() -> tuple[ls.Problem, ls.Problem]:
    """A point mass with a radius, and the same with one ball."""
    ball = ls.CollisionSpheres(lambda x, p: [[x[0], x[1]]], [point_mass.RADIUS])
    world, effort = point_mass.balls((0.0, 0.1, 0.5), (0.9, -0.3, 0.2)), ls.ControlCost([0.1, 0.1])
    stage = effort + ls.ObstacleCost(world, radius=point_mass.RADIUS, weight=2.0)
    first = dataclasses.replace(point_mass.problem(world), stage_cost=stage)
    stage = effort + ls.ObstacleCost(world, balls=ball, weight=2.0)
    kept = [ls.Clearance(world, balls=ball, margin=point_mass.MARGIN)]
    return first, dataclasses.replace(first, stage_cost=stage, constraints=kept)


class TestOneBallAtThePosition:
    """It is what a radius is."""

    def test_numbers(self, pair: tuple[ls.Problem, ls.Problem]) -> None:
        rng = np.random.default_rng(3)
        one, other = (problem.terms("stage_cost")[1] for problem in pair)
        for _ in range(10):
            x, u = 2 * rng.normal(size=4), rng.normal(size=2)
            for mine, theirs in zip(evaluate(one, x, u), evaluate(other, x, u), strict=True):
                np.testing.assert_allclose(theirs, mine, rtol=1e-12, atol=1e-12)

    @pytest.mark.long
    def test_plans(self, pair: tuple[ls.Problem, ls.Problem]) -> None:
        """To what the iterations leave open."""
        one, other = (ls.smooth(problem) for problem in pair)
        assert other.success
        assert other.cost == pytest.approx(one.cost, rel=1e-6)
        np.testing.assert_allclose(other.trajectory.states, one.trajectory.states, rtol=0, atol=1e-5)
        assert one.clearance is not None
        assert other.clearance is not None
        np.testing.assert_allclose(other.clearance, one.clearance, rtol=0, atol=1e-5)


class TestLevels:
    """The same places as a formula, a numba function and a plain one."""

    @staticmethod
    def jacobian(x, p, slopes):
        a, ab, abc = x[0], x[0] + x[1], x[0] + x[1] + x[2]
        for j in range(3):
            if j < 1:
                slopes[1:, 0, j] -= p.length * np.sin(a)
                slopes[1:, 1, j] += p.length * np.cos(a)
            if j < 2:
                for k, part in ((1, SHARE), (2, 1.0)):
                    slopes[k, 0, j] -= part * p.length * np.sin(ab)
                    slopes[k, 1, j] += part * p.length * np.cos(ab)
            slopes[2, 0, j] -= p.length * np.sin(abc)
            slopes[2, 1, j] += p.length * np.cos(abc)

    @pytest.mark.parametrize(
        ("with_jacobian", "level"),
        [(False, "plain"), (True, "plain"), *rarely((False, "compiled"), (True, "compiled"))],
    )
    def test_numbers(self, level: str, with_jacobian: bool) -> None:
        jacobian = self.jacobian if with_jacobian else None
        options = {"level": level, "jacobian": jacobian, "depends_on": STATES[:3]}
        function = numba.njit(three_numbers) if level == "compiled" and not with_jacobian else three_numbers
        balls = ls.CollisionSpheres(function, RADII, **options)
        ours, theirs = (
            ls.ObstacleCost(WORLD, balls=one, sharpness=SHARPNESS).bind(ARM.dynamics) for one in (balls, THREE)
        )
        assert ours.nonconvex_in == theirs.nonconvex_in
        state = draw(1)
        pairs = (evaluate(term, state, np.zeros(3)) for term in (ours, theirs))
        for mine, symbolic in zip(*pairs, strict=True):
            np.testing.assert_allclose(mine, symbolic, rtol=1e-12 if with_jacobian else 1e-8, atol=1e-9)
        found = balls.centres(ARM.dynamics, np.array([state, 2 * state]))
        np.testing.assert_allclose(found, [in_numpy(state), in_numpy(2 * state)], rtol=0, atol=1e-12)

    @pytest.mark.parametrize("level", ["compiled", "plain"])
    @pytest.mark.long
    def test_plans(self, level: str) -> None:
        """The same plan, which the balls' clearance and cost shape, whoever says where they are."""
        world = ls.World(
            [ls.Obstacle("rock", "sphere", np.array([1.34, 0.35, 0.1]), np.eye(3), np.array([0.1, 0.0, 0.0]))]
        )

        def solved(balls: ls.CollisionSpheres) -> ls.Solution:
            start, goal = (-0.2, 0.1, 0.1, 0.0, 0.0, 0.0), (0.55, 0.1, 0.1, 0.0, 0.0, 0.0)
            problem = ls.Problem(
                dynamics=ARM.dynamics, dt=0.1, steps=20, initial=ls.FixedState(start), control_limits=(-2.0, 2.0),
                stage_cost=ls.ControlCost([1.0] * 3) + ls.ObstacleCost(world, balls=balls, weight=0.01),
                final_cost=ls.QuadraticCost(np.full(6, 100.0), about=goal),
                constraints=[ls.Clearance(world, balls=balls, margin=0.05)],
            )  # fmt: skip
            return ls.smooth(problem, starts=1, tolerance=1e-7, gap_tolerance=1e-4)

        theirs = solved(THREE)
        assert theirs.success
        assert theirs.multipliers  # it presses
        # Both with a Jacobian: so they are compiled once, and `test_numbers` has them without.
        ours = solved(
            ls.CollisionSpheres(three_numbers, RADII, level=level, depends_on=STATES[:3], jacobian=self.jacobian)
        )
        assert ours.status is theirs.status
        assert ours.cost == pytest.approx(theirs.cost, rel=1e-6)
        np.testing.assert_allclose(ours.trajectory.states, theirs.trajectory.states, rtol=0, atol=1e-4)

    def test_a_plain_function_that_raises_is_told_of(self) -> None:
        def failing(x, p):
            if x[0] > 1:
                raise ValueError("too far")
            return np.zeros((1, 3))

        balls = ls.CollisionSpheres(failing, [0.1], level="plain")
        with pytest.raises(ValueError, match="too far"):
            balls.centres(ARM.dynamics, np.full(6, 2.0))


class TestCapsule:
    @pytest.mark.parametrize(("length", "radius", "tolerance"), [(0.4, 0.03, 0.002), (1.0, 0.1, 0.01), (0.2, 0.3, 0.5)])
    def test_it_sticks_out_by_what_is_said(self, length: float, radius: float, tolerance: float) -> None:
        """Of points all over its surface, and by one ball fewer it would be more than asked."""
        capsule = ls.types.Capsule(length, radius, tolerance)
        assert capsule.missed <= tolerance
        centres = np.array(capsule.between((0.0, 0.0, 0.0), (length, 0.0, 0.0)))
        along = np.linspace(0, length, 2001)
        reach = np.sqrt(np.max(radius**2 - (along[:, None] - centres[:, 0]) ** 2, axis=1).clip(0))
        assert radius - reach.min() == pytest.approx(capsule.missed, abs=1e-6)
        fewer = length / (capsule.count - 2) / 2 if capsule.count > 2 else np.inf
        assert fewer >= radius or radius - np.sqrt(radius**2 - fewer**2) > tolerance

    def test_clearances_are_those_of_mujoco_within_what_is_missed(self, tmp_path: Path) -> None:
        """Of the links, by its own distance between capsules and other geoms, at random angles."""
        scene = ARM.scene(tmp_path)
        model, data = scene.model, mujoco.MjData(scene.model)
        links = [model.geom(f"link {i}").id for i in range(3)]
        rng, seen = np.random.default_rng(0), 0
        for _ in range(40):
            state = np.concatenate([rng.uniform(-np.pi, np.pi, 3), np.zeros(3)])
            data.qpos[:] = state[:3]
            mujoco.mj_forward(model, data)
            at = ARM.balls.centres(ARM.dynamics, state)
            ours = (scene.world.distance(at) - ARM.balls.radii).reshape(3, LINK.count).min(axis=1)
            for link, clearance in zip(links, ours, strict=True):
                theirs = min(
                    mujoco.mj_geomDistance(model, data, link, model.geom(name).id, 5.0, None)
                    for name in scene.world.names
                )
                if theirs > 0:
                    seen += 1
                    assert -1e-6 <= clearance - theirs <= LINK.missed + 1e-6
        assert seen > 60

    def test_of_no_length_it_is_a_ball(self) -> None:
        assert ls.types.Capsule(0.0, 0.1, 0.01).count == 1
        assert ls.types.Capsule(0.0, 0.1, 0.01).missed == 0

    def test_pickled(self) -> None:
        assert pickle.loads(pickle.dumps(LINK)) == LINK


def nobody(x, p):
    return [[0, 0, 0]]


def of_another_size(x, p):
    return [[0, 0, 0], [0, 0]]


def in_the_plane(x, p):
    return [[x[0], x[1]]]


def of_the_unknown(x, p):
    return [[p.height, 0, 0]]


def with_u(x, u, p):
    return [[0, 0, 0]]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: ls.CollisionSpheres(nobody, [0.1, 0.1]).bind(ARM.dynamics),
            "got 1 points, want 2 points of 3 coordinates, one for each of radii",
        ),
        (lambda: ls.CollisionSpheres(nobody, [-0.1]), "radii: got -0.1 for ball 0, want at least 0"),
        (lambda: ls.CollisionSpheres(nobody, []), "radii: got none"),
        (lambda: ls.CollisionSpheres(nobody, 0.1), "radii: got shape"),
        (lambda: ls.CollisionSpheres(nobody, [np.nan]), "radii"),
        (lambda: ls.CollisionSpheres(of_another_size, [0.1, 0.1]).bind(ARM.dynamics), "points of 2 and 3 coordinates"),
        (
            lambda: ls.CollisionSpheres(in_the_plane, [0.1]).bind(ls.Quadrotor().dynamics),
            "2 coordinates for a position in space",
        ),
        (
            lambda: ls.CollisionSpheres(of_the_unknown, [0.1]).bind(ARM.dynamics),
            "parameter: got 'height', want one of: length",
        ),
        (lambda: balls_of(with_u, [0.1]), "want a function of \\(x, p\\)"),
        (lambda: ls.CollisionSpheres(nobody, [0.1], names=("a", "b")), "names: got"),
        (lambda: ls.CollisionSpheres(nobody, [0.1], sites=("a", "b")), "sites: got 2"),
        (lambda: balls_of(nobody, [0.1], jacobian=nobody), "jacobian: got a derivative of nobody, which is symbolic"),
        (
            lambda: ls.CollisionSpheres(nobody, [0.1], depends_on=("a",)),
            "depends_on: got names for a symbolic function",
        ),
        (
            lambda: ls.CollisionSpheres(three_numbers, RADII, level="plain", depends_on=("shoulder", "knee")).bind(
                ARM.dynamics
            ),
            "depends_on: got 'knee', want one of",
        ),
        (
            lambda: ls.CollisionSpheres(lambda x, p: np.zeros((3, 1)), [0.1], level="plain").bind(ARM.dynamics),
            "got 3 points, want 1",
        ),
        (lambda: ls.ObstacleCost(WORLD, radius=0.1, balls=THREE), "ObstacleCost: got radius and balls, want one"),
        (lambda: ls.Clearance(WORLD), "Clearance: got none of radius, balls and geoms, want one"),
        (lambda: ls.ObstacleCost(WORLD, balls=[0.1]), "ObstacleCost: balls: got"),  # pyright: ignore
        (lambda: ls.ObstacleCost(WORLD, radius=0.1).bind(ARM.dynamics), "without a position, want .* or balls="),
        (lambda: ls.types.Capsule(1.0, 0.1, 0.0), "Capsule: tolerance: got 0"),
        (lambda: ls.types.Capsule(1.0, -0.1, 0.1), "Capsule: radius: got -0.1"),
        (lambda: ls.types.Capsule(1e6, 0.1, 1e-9), "balls, want at most 10000"),
        (lambda: LINK.between((0, 0), (0, 0, 0)), "between: got"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make: Any, said: str) -> None:
    with pytest.raises(ls.InputError, match=said):
        make()


def test_a_start_inside_an_obstacle_names_the_ball() -> None:
    inside = ls.World([ls.Obstacle("rock", "sphere", np.array([0.8, 0, 0.1]), np.eye(3), np.array([0.1, 0, 0]))])
    with pytest.raises(ls.InputError, match=r"a start with 'ball \d+' at .* inside obstacle 'rock'"):
        ls.Problem(
            dynamics=ARM.dynamics, dt=0.05, steps=3, initial=ls.FixedState(np.zeros(6)),
            stage_cost=ls.ControlCost(np.ones(3)) + ls.ObstacleCost(inside, balls=ARM.balls),
            final_cost=ls.QuadraticCost(np.ones(6), about=np.zeros(6)),
        )  # fmt: skip
