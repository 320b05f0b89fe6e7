"""Links of a robot that keep clear of each other: which, how far, and plans, against MuJoCo's own contacts."""

import itertools

import mechanisms
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import FLOATING
from sampling import examples

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml

NEAR = 1e-6  # m, MuJoCo's own tolerance of distances; ours is less


def by_mujoco(robot: ls.MjcfRobot, state: Array, links: tuple[tuple[str, str], ...]) -> Array:
    """The least distance of the geoms of two bodies, all of which collide, by `mujoco.mj_geomDistance`."""
    model, data = robot.mjcf.model, mujoco.MjData(robot.mjcf.model)
    data.qpos[:] = robot.configuration(state)[0]
    mujoco.mj_kinematics(model, data)
    geoms = {model.body(body).name: np.flatnonzero(model.geom_bodyid == body) for body in range(model.nbody)}
    pairs = [itertools.product(geoms[one], geoms[other]) for one, other in links]
    return np.array([min(mujoco.mj_geomDistance(model, data, *pair, 1.0, None) for pair in each) for each in pairs])


def contacts(robot: ls.MjcfRobot, states: Array) -> int:
    """The number of MuJoCo's contacts in these states."""
    model, data, count = robot.mjcf.model, mujoco.MjData(robot.mjcf.model), 0
    for qpos in robot.configuration(states)[0]:
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        count += data.ncon
    return count


TAIL = """<body name="tail" pos="-0.2 0 0.1"><joint name="wag" axis="0 0 1"/><geom type="mesh" mesh="rock"/></body>"""
KINDS = {"box": 'size="0.08 0.03 0.03"', "ellipsoid": 'size="0.08 0.04 0.03"', "mesh": 'mesh="rock"'}


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=examples(8))
@given(seed=st.integers(0, 2**32 - 1))
def test_distances_are_mujocos_and_slopes_those_of_differences(kind: str, seed: int) -> None:
    """With a free and a ball joint: both links move, and in other coordinates than MuJoCo's."""
    xml = FLOATING.format(things="", link=f'type="{kind}" {KINDS[kind]}', more=TAIL, motors='<motor joint="wag"/>')
    robot = ls.MjcfRobot(scene_from_xml(xml, "floating"))
    rng, n = np.random.default_rng(seed), len(robot.dynamics.state_coordinates)
    state = robot.at() + np.concatenate([rng.normal(0, 0.5, n // 2), np.zeros(n // 2)])
    kept = robot.self_clearance(1.0)
    assert kept.links == (("hull", "fore"), ("upper", "tail"), ("fore", "tail"))
    found = kept.distances(robot.dynamics, state)
    np.testing.assert_allclose(found, by_mujoco(robot, state, kept.links), rtol=0, atol=2 * NEAR)
    problem = ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=1, initial=ls.FixedState(state), stage_cost=ls.ControlCost([1.0, 1.0]),
        final_cost=ls.QuadraticCost(np.ones(n), about=state), constraints=[kept],
    )  # fmt: skip
    checks = [one for one in ls.check_derivatives(problem, samples=1, spread=0.0) if "clearance" in one.what]
    assert len(checks) == 3
    # The differences divide MuJoCo's error of 1e-10 m by 1e-5 rad.
    apart = found > 1e-3  # of overlapping meshes the direction jumps from side to side
    assert all(one.good for one, clear in zip(checks, apart, strict=True) if clear), checks


def drawn_tree(seed: int) -> str:
    """A tree of bodies, with joints or fixed to others that move, with excludes, a pair and bits."""
    rng = np.random.default_rng(seed)
    parents = [int(rng.integers(-1, k)) for k in range(7)]
    kinds = ["", 'contype="2" conaffinity="1"', 'contype="0" conaffinity="2"', 'contype="2" conaffinity="2"']
    inner, joints = dict.fromkeys(range(-1, 7), ""), list[int]()
    for k in reversed(range(7)):
        joints += [k] if rng.random() < 0.7 or parents[k] < 0 else []
        joint = f'<joint name="j{k}" axis="0 0 1"/>' if k in joints else ""
        x, y, z = rng.uniform(-1, 1, 3)
        geom = f'<geom name="g{k}" size="0.005" {rng.choice(kinds)}/>'
        inner[parents[k]] += f'<body name="b{k}" pos="{x} {y} {z}">{joint}{geom}{inner[k]}</body>'
    first, second, third, fourth = rng.permutation(7)[:4].tolist()
    contact = f'<exclude body1="b{first}" body2="b{second}"/><pair geom1="g{third}" geom2="g{fourth}"/>'
    driven, option = mechanisms.motors([f"j{k}" for k in joints]), 'gravity="0 0 0"'
    return mechanisms.scene(inner[-1], driven, more=f"<contact>{contact}</contact>", option=option)


@settings(max_examples=examples(60))
@given(seed=st.integers(0, 2**32 - 1))
def test_links_are_those_that_mujoco_lets_collide(seed: int) -> None:
    """With margins of 10 m all pairs that may touch are contacts."""
    robot = ls.MjcfRobot(scene_from_xml(drawn_tree(seed), "tree"))
    spec = robot.mjcf.spec()
    for one in (*spec.geoms, *spec.pairs):
        one.margin = 10.0
    wide = spec.compile()
    data = mujoco.MjData(wide)
    mujoco.mj_forward(wide, data)
    bodies = wide.body_weldid[wide.geom_bodyid[data.contact.geom.reshape(-1, 2)]]
    expected = {tuple(wide.body(body).name for body in sorted(pair)) for pair in bodies.tolist()}
    if expected:
        assert set(robot.self_clearance().links) == expected
    else:
        with pytest.raises(ls.InputError, match="self_clearance: got no pair of links that can collide"):
            robot.self_clearance()


# Elbow and wrist at the start and at the goal: the hand points past the upper arm on one side, then on the other.
THROUGH = [((2.58, 3.49), (1.94, 2.18)), ((2.38, 1.6), (2.06, 3.36)), ((2.12, 1.38), (2.38, 3.31))]


def arm(base: str = "", things: str = "", *, first: str = "", motors: str = "") -> ls.MjcfRobot:
    """Other bodies come before the arm or after it; `motors` are besides those of the joints."""
    links = mechanisms.arm(
        0.35, 0.3, 0.22, names=("shoulder", "elbow", "wrist"), joint='axis="0 0 1" damping="0.1"',
        geom='size="0.02" mass="0.5"', gap=0.05, option='gravity="0 0 0" timestep="0.01" integrator="implicitfast"',
    )  # fmt: skip
    whole = links.replace("<worldbody>", f'<worldbody>{first}<body name="base">{base}').replace(
        "</worldbody>", f"</body>{things}</worldbody>"
    )
    return ls.MjcfRobot(scene_from_xml(whole.replace("</actuator>", f"{motors}</actuator>"), "arm"), body="upper")


@pytest.mark.parametrize("motors", ["", '<adhesion body="hand" ctrlrange="0 1" gain="1"/>'])
@pytest.mark.parametrize("place", ["first", "things"])
def test_links_keep_clear_of_their_base_but_not_of_what_they_handle(place: str, motors: str) -> None:
    """The upper arm is within the base in every position, and a box on the floor is no link, wherever it stands.

    A hand that holds by suction moves nothing before it touches something.
    """
    base = '<geom type="cylinder" size="0.06 0.1"/>'
    box = '<body name="box" pos="0.5 0 0"><freejoint/><geom type="box" size="0.05 0.05 0.05"/></body>'
    robot = arm(base, motors=motors, **{place: box})
    assert robot.self_clearance().links == (("base", "fore"), ("base", "hand"), ("upper", "hand"))


@pytest.mark.parametrize(("start", "goal"), THROUGH)
def test_a_hand_goes_round_the_upper_arm(start: tuple[float, float], goal: tuple[float, float]) -> None:
    robot = arm()
    one, other = (robot.at(elbow=elbow, wrist=wrist) for elbow, wrist in (start, goal))
    assert contacts(robot, np.linspace(one, other, 20)) > 0
    solution = ls.smooth(robot.problem(one, other, steps=50, dt=0.02, self_clearance=0.01))
    assert solution.success
    distances = [by_mujoco(robot, state, (("upper", "hand"),)) for state in solution.trajectory.states]
    # The constraint acts; its tolerance, and MuJoCo's of distances.
    assert np.min(distances) == pytest.approx(0.01, abs=1e-5)
    rollout = ls.simulate(ls.Plant(robot, robot.scene), solution)
    assert contacts(robot, rollout.states[0]) == 0


def test_many_links_have_one_row_each(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = arm('<geom type="cylinder" size="0.06 0.1"/>')
    kept, rows = robot.self_clearance(0.01), []
    for most in (3, 2):
        monkeypatch.setattr("lqrsim.problem.obstacles.MOST_ROWS", most)
        term = kept.bind(robot.dynamics)
        rows.append([term.describe(row) for row in range(term.rows)])
    assert rows[0][1] == "a clearance of 0.01 m between 'base' and 'hand'"
    assert rows[1] == [f"a clearance of 0.01 m between {one!r} and other links" for one in ("base", "upper")]


def test_what_can_not_be_kept_apart_is_refused() -> None:
    robot = arm()
    there, crossed = robot.at(elbow=2.0, wrist=1.0), robot.at(elbow=2.5, wrist=2.7)
    told = r"^goal: got a state with 'upper' and 'hand' at -0\.\d+ m from each other, want 0\.01 m; or, .*<exclude"
    with pytest.raises(ls.InputError, match=told):
        robot.problem(there, crossed, self_clearance=0.01)
    with pytest.raises(ls.InputError, match=r"^start: got a state with"):
        robot.problem(crossed, there, self_clearance=0.01)
    with pytest.raises(ls.InputError, match="self_clearance: got nan, want a finite number"):
        robot.problem(there, there, self_clearance=np.nan)
    with pytest.raises(ls.InputError, match=r"SelfClearance: got dynamics .*, want the robot's own, robot.dynamics"):
        robot.self_clearance().bind(ls.Quadrotor().dynamics)
