"""Robots in a plane: what they see of the world, against MuJoCo, and who is refused because it moves in another."""

import dataclasses
import re
from pathlib import Path

import mujoco
import numpy as np
import planar_quadrotor
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from mechanisms import Jointed, scene, sled
from planar_quadrotor import BLOCK, PlanarQuadrotor, mjcf
from sampling import examples
from scipy.spatial.transform import Rotation
from tracking import track

import lqrsim as ls
from lqrsim.control.prediction import Surroundings
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.scenes.world import KINDS, PLANES
from lqrsim.simulation.disturbances import Effect
from lqrsim.view import cameras, gl, plots, viewer
from lqrsim.view.viewer import Viewer

draws = pytest.mark.skipif(bool(gl.missing()), reason=f"no OpenGL here: {gl.INSTALL}")
SIDES = '<geom name="beside" type="plane" size="1 1 1" pos="0 0.9 0" zaxis="0 -1 0"/>'
FLOOR = '<geom name="floor" type="plane" size="4 4 1" pos="0 0 -1.2"/>'


def space(names: tuple[str, ...], **fields: object) -> ls.types.Coordinates:
    """Coordinates with a position of these names, and an angle, which is all that there is without any."""
    count = len(names)
    units = ("m",) * count + ("rad",)
    return ls.types.Coordinates(names=(*names, "angle"), units=units, position=tuple(range(count)), **fields)  # pyright: ignore


@pytest.mark.parametrize(
    ("names", "given", "plane", "offset"),
    [
        (("x", "y"), {}, "xy", None),
        (("x", "z"), {}, "xz", 0.0),
        (("y", "x"), {}, "yx", None),
        (("p_y", "p_z"), {"offset": 1.5}, "yz", 1.5),
        (("Pos_X", "Pos_Z"), {}, "xz", 0.0),
        (("north", "west"), {}, "xy", None),
        (("x1", "z1"), {}, "xz", 0.0),
        (("y_tip", "z_tip"), {}, "yz", 0.0),
        (("north", "height"), {"plane": "xz"}, "xz", 0.0),
        (("x", "y"), {"offset": 0.3}, "xy", 0.3),
        (("x", "y", "z"), {}, "xyz", None),
        (("a", "b", "c"), {}, "xyz", None),
        ((), {}, "", None),
    ],
)
def test_the_plane_is_given_or_follows_from_the_names(names, given, plane, offset):
    found = space(names, **given)
    assert (found.plane, found.offset) == (plane, offset)
    assert dataclasses.replace(found, names=found.names) == found
    if plane:
        # The axes of the world are those that the letters say.
        places = np.arange(1.0, 1.0 + len(plane))
        point = found.in_world(places, height=7.0)
        assert point["xyz".index(plane[0])] == 1.0
        assert point["xyz".index(plane[1])] == 2.0
        assert point.sum() == places.sum() + (0 if len(plane) == 3 else 7.0 if offset is None else offset)
        np.testing.assert_array_equal(found.of_world(point), places)


@pytest.mark.parametrize(
    ("names", "given", "message"),
    [
        (("x", "height"), {"plane": "xh"}, "plane: got 'xh', want one of: xy, xz, yx, yz, zx, zy"),
        (("x", "z"), {"plane": "xy"}, r"plane: got 'xy' for the position \(x, z\), want 'xz', or other names"),
        (("north", "z"), {}, r"plane: got none for the position \(north, z\), whose names do not tell the plane"),
        (("left_x", "right_x"), {}, "whose names do not tell the plane"),
        (("x", "height"), {}, "whose names do not tell the plane"),
        (("distance", "Height"), {}, "whose names do not tell the plane"),
        (("y", "x", "z"), {}, r"position: got \(y, x, z\), want it along x, y and z in this order: \(x, y, z\)"),
        (("x", "y", "z"), {"plane": "xz"}, "plane: got 'xz' for the position .* want none: the position is spatial"),
        (("x", "y", "z"), {"offset": 1.0}, "offset: got 1.0 without a plane"),
        ((), {"plane": "xz"}, "plane: got 'xz' without a position"),
        (("x", "z"), {"offset": np.nan}, "offset: got nan, want a finite number"),
    ],
)
def test_a_plane_that_contradicts_is_refused(names, given, message):
    with pytest.raises(ls.InputError, match=message):
        space(names, **given)


def things(rng: np.random.Generator, count: int) -> list[ls.Obstacle]:
    """Obstacles of all kinds, turned in any way, but planes, which are level or upright as often as not."""
    found = []
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        rotation = Rotation.random(rng=rng).as_matrix()
        if kind == "plane" and rng.random() < 0.5:
            rotation = np.roll(np.eye(3), rng.integers(3), axis=0)
        size = np.zeros(3) if kind == "plane" else rng.uniform(0.1, 0.7, 3)
        found.append(ls.Obstacle(f"{kind} {number}", kind, rng.normal(size=3) * 1.5, rotation, size))
    return found


@settings(max_examples=examples(100))
@given(seed=st.integers(0, 2**32 - 1), plane=st.sampled_from(PLANES), offset=st.floats(-2, 2))
def test_a_world_that_is_cut_is_as_far_as_mujoco_says(seed: int, plane: str, offset: float) -> None:
    """Of a ball of 1 cm at the place in the world, but for planes along the robot's; 1e-4 m is MuJoCo's solver's."""
    rng = np.random.default_rng(seed)
    world, ways = ls.World(things(rng, 5)), space(("a", "b"), plane=plane, offset=offset)
    seen = world.seen_by(ways.plane, ways.offset)
    across = 3 - sum(ways.world_axes)
    parallel = [one.name for one in world.obstacles if one.kind == "plane" and abs(one.rotation[across, 2]) > 1 - 1e-9]
    assert seen.names == tuple(name for name in world.names if name not in parallel)
    geoms = "".join(
        f'<geom name="{one.name}" type="{one.kind}" size="{numbers(one.size if one.size.any() else [1, 1, 1])}"'
        f' pos="{numbers(one.position)}" xyaxes="{numbers(one.rotation[:, :2].T.ravel())}"/>'
        for one in world.obstacles
    )
    ball = '<body name="ball" mocap="true"><geom name="ball" size="0.01"/></body>'
    model = mujoco.MjModel.from_xml_string(scene(ball, things=geoms))
    data = mujoco.MjData(model)
    for place in rng.normal(size=(5, 2)) * 2:
        data.mocap_pos[0] = ways.in_world(place)
        mujoco.mj_kinematics(model, data)
        distances = seen.distances(place)
        for name, distance in zip(seen.names, distances, strict=True):
            if distance > 0.05:  # inside, MuJoCo says the depth of the deepest point
                pair = model.geom(name).id, model.geom("ball").id
                assert abs(0.01 + mujoco.mj_geomDistance(model, data, *pair, 50.0, None) - distance) < 1e-4


def numbers(values) -> str:
    return " ".join(repr(float(value)) for value in values)


def test_the_order_of_the_axes_changes_nothing_but_the_order() -> None:
    upright = list(ls.load_scene("arena").world.obstacles)
    world, rng = ls.World(upright), np.random.default_rng(0)
    for plane, offset in (("xy", None), ("xz", 0.2), ("yz", -0.3), ("xy", 0.05)):
        there, back = world.seen_by(plane, offset), world.seen_by(plane[::-1], offset)
        for place in rng.normal(size=(20, 2)):
            np.testing.assert_allclose(there.distances(place), back.distances(place[::-1]), rtol=0, atol=1e-12)
    with pytest.raises(ls.InputError, match="offset: got none for the plane 'xz'"):
        world.seen_by("xz")


# The whole way of a planar quadrotor: plan, physics, figure, pixels


@pytest.fixture(scope="module")
def flown() -> tuple[ls.Plant, ls.Solution, ls.Rollout]:
    scene = scene_from_xml(mjcf(BLOCK + FLOOR + SIDES), "planar")
    plant = ls.Plant(PlanarQuadrotor(), scene)
    # Over the block: from 0.2 to 0.3 m the plan would stop before it, in a minimum that is only local.
    solution = ls.smooth(planar_quadrotor.problem(PlanarQuadrotor(), scene.world, goal=(2.11, 1.3)))
    return plant, solution, ls.simulate(plant, solution)


def ball_distances(plant: ls.Plant, frames: Array, names: tuple[str, ...], moved: Array | None = None) -> Array:
    """The distance that MuJoCo sees between the drone's ball and the nearest geom, at each qpos."""
    data, found = mujoco.MjData(plant.model), []
    for number, name in enumerate(names if moved is not None else ()):
        plant.model.geom(name).pos += moved[number]  # pyright: ignore[reportOptionalSubscript]
    for frame in frames:
        data.qpos = frame
        mujoco.mj_kinematics(plant.model, data)
        pairs = [(plant.model.geom(name).id, plant.model.geom("ball").id) for name in names]
        found.append(min(mujoco.mj_geomDistance(plant.model, data, *pair, 50.0, None) for pair in pairs))
    return np.array(found)


def test_the_plan_of_a_planar_quadrotor_is_as_clear_as_mujoco_says(flown) -> None:
    plant, solution, rollout = flown
    assert solution.status.name == "CONVERGED"
    assert plant.world.names == ("block", "floor")  # the wall beside it does not bound it
    assert solution.clearance.min() > 0.05 - 1e-6
    frames = plant.robot.configuration(solution.trajectory.states)[0]
    theirs = ball_distances(plant, frames, plant.world.names)
    np.testing.assert_allclose(solution.clearance, theirs, rtol=0, atol=1e-4)  # the accuracy of MuJoCo's solver
    at_knots = np.abs(rollout.frame_times[:, None] - rollout.times).argmin(axis=0)
    theirs = ball_distances(plant, rollout.frames[0, at_knots], plant.world.names)
    np.testing.assert_allclose(rollout.clearance[0], theirs, rtol=0, atol=1e-4)
    assert rollout.outcome == ("reached",)
    assert rollout.contacts[0] == 0


def test_obstacles_that_are_displaced_are_seen_where_they_are(flown) -> None:
    plant, solution, _ = flown
    rollout = ls.simulate(plant, solution, disturbances=[ls.disturbances.DisplacedObstacles(0.05)], seed=3)
    moved = rollout.displaced[0]
    assert np.abs(moved[0]).min() > 0  # across the plane, too
    assert (moved[1] == 0).all()  # a floor stays
    at_knots = np.abs(rollout.frame_times[:, None] - rollout.times).argmin(axis=0)
    fresh = ls.Plant(plant.robot, plant.scene)
    theirs = ball_distances(fresh, rollout.frames[0, at_knots], ("block", "floor"), moved)
    np.testing.assert_allclose(rollout.clearance[0], theirs, rtol=0, atol=1e-4)


class Lifted(ls.disturbances.Disturbance):
    """Obstacles are so much higher than the plan has them, in metres."""

    def __init__(self, *heights: float) -> None:
        self.heights = heights

    def start(self, plant: ls.Plant, plan: ls.Trajectory, generators: object) -> Effect:
        return Effect(displaced=np.array([[(0.0, 0.0, height) for height in self.heights]]))


@pytest.mark.parametrize("contacts", [True, False])
@pytest.mark.parametrize("lift", [0.0, 1.0])
@pytest.mark.parametrize(("names", "offset"), [(("x", "z"), 0.7), (("y", "z"), -2.0)])
def test_a_hit_between_two_knots_is_one_in_a_vertical_plane(names, offset, lift, contacts) -> None:
    """At 20 m/s over a rod across the plane: nowhere that is looked at is within it, the line between two places is."""
    level = names[0]
    where, along = (f"0 {offset}", "0 1 0") if level == "x" else (f"{offset} 0", "1 0 0")
    rods = "".join(
        f'<geom name="{name}" type="cylinder" size="0.3 0.2" pos="{where} {height}" zaxis="{along}"/>'
        for name, height in (("near", 0.08), ("rod", 0.2 - lift))
    )
    plant = fitted(PlanarQuadrotor(names=names, offset=offset), things=rods, level=level, y=offset)
    assert plant.enclosed  # it touches nothing at a clearance above 0
    # Its radius is 0.2; it flies 0.48 m above the rod's axis, and 0.6 m above that of the other one. What is looked at
    # is 0.4 m apart: about 0.2 m before the rod, and about as far behind it.
    hover = planar_quadrotor.MASS * planar_quadrotor.GRAVITY / 2
    solution = track(plant.robot, (-1.0, 0.68, 0, 20, 0, 0), np.full((3, 2), hover), 0.04, feedback=False)
    rollout = ls.simulate(plant, solution, disturbances=[Lifted(0.0, lift)], contacts=contacts)
    assert (rollout.outcome, rollout.obstacles) == (("collided",), ("rod",))
    if contacts:
        assert rollout.contacts[0] > 0
    else:
        assert (rollout.clearance >= 0).all()
        place, height = (np.interp(rollout.collided_at[0], rollout.times, rollout.states[0, :, i]) for i in (0, 1))
        chord = np.sqrt(0.5**2 - (height - 0.2) ** 2)
        # A look each fiftieth of the radius; the drag's 2 m/s^2 over a step of 0.04 s bend the time by 1 mm at most.
        assert -chord - 1e-3 <= place <= -chord + 0.02 * 0.2 + 1e-3


def test_the_figures_show_the_cut(flown, tmp_path: Path) -> None:
    plant, solution, rollout = flown
    ls.view.plot_run(solution, {"run": rollout}, tmp_path / "run.svg", world=plant.scene.world)
    labels = (tmp_path / "run.svg").read_text()
    assert "x (m)" in labels
    assert "z (m)" in labels
    assert "y (m)" not in labels
    figure = Figure()
    plots.draw_policy(figure, solution, plant.scene.world, plant.robot.radius)
    axes = figure.axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "z (m)")
    # The block's outline in it has the lower corners of the cut: half sizes 0.15 and 0.8 about (0, 0.2).
    outlines = np.vstack([np.asarray(path.vertices) for one in axes.collections for path in one.get_paths()])
    block = outlines[(np.abs(outlines[:, 0]) < 0.5) & (np.abs(outlines[:, 1] - 0.2) < 1.0)]
    for corner in ((0.15, -0.6), (-0.15, -0.6)):
        assert np.linalg.norm(block - corner, axis=1).min() < 0.05


@draws
def test_pixels_tell_where_a_planar_quadrotor_is(flown, tmp_path: Path) -> None:
    _, solution, rollout = flown
    assert cameras.measuring(rollout.plane) == ("side",)
    assert abs(cameras.calibrated("side", rollout).forward[1]) == 1
    found = ls.verify_run(rollout, solution=solution)
    assert found.passed, found
    video = ls.render(rollout, tmp_path / "run.mp4", camera="side", size=(640, 480), fps=10)
    found = ls.verify_video(video, rollout, solution=solution)
    assert found.passed, found
    with pytest.raises(ls.InputError, match="views: got top, want side to measure"):
        ls.verify_video(ls.render(rollout, tmp_path / "top.mp4", camera="top", fps=2), rollout)


class Seen(Viewer):
    """A viewer that remembers what it is told to draw."""

    def refresh(self) -> bool:
        return True


def test_viewers_draw_the_plan_where_the_robot_moves() -> None:
    robot = PlanarQuadrotor(names=("y", "z"), offset=-2.0)
    plant = fitted(robot, level="y", y=-2.0, things="")
    hover = planar_quadrotor.MASS * planar_quadrotor.GRAVITY / 2
    solution = track(robot, (0.0, 1.0, 0.0, 0.5, 0.0, 0.0), np.full((20, 2), hover), 0.02)
    rollout = ls.simulate(plant, solution)
    for options in (viewer.arguments_for_plant(plant, solution), viewer.arguments_for_rollout(rollout, 0)):
        screen = Seen(**options, speed=1000.0)
        for time, qpos in zip(rollout.frame_times, rollout.frames[0], strict=True):
            place = screen.show(float(time), qpos)
            np.testing.assert_allclose(place, screen.planned_position(), rtol=0, atol=1e-4)  # it keeps to its plan
            assert place[0] == -2.0
        assert screen.caption.endswith(" 0 mm from the plan")
        drawn = [shape.set(mujoco.MjvGeom()) for shape in screen.overlay_shapes()]
        assert {round(float(geom.pos[0]), 6) for geom in drawn} == {-2.0}
        assert drawn[-1].type == mujoco.mjtGeom.mjGEOM_SPHERE


# Robots whose dynamics are of another plane than their joints


def fitted(robot: PlanarQuadrotor, **scene) -> ls.Plant:
    return ls.Plant(robot, scene_from_xml(mjcf(**scene), "planar"))


def test_a_robot_in_another_plane_fits_with_its_plane_and_where_it_is() -> None:
    assert fitted(PlanarQuadrotor(), y=0.0).world.names == ("block",)
    fitted(PlanarQuadrotor(offset=0.7), y=0.7)
    fitted(PlanarQuadrotor(names=("y", "z")), level="y")
    fitted(PlanarQuadrotor(names=("along", "height"), plane="yz", offset=-2.0), level="y", y=-2.0)


@pytest.mark.parametrize(
    ("robot", "scene", "message"),
    [
        (PlanarQuadrotor(names=("a", "b")), {}, r"the plane 'xy'; .* a along \+x, b along \+z; want plane='xz'"),
        (PlanarQuadrotor(names=("a", "b"), plane="zx"), {}, "want plane='xz'"),
        (
            PlanarQuadrotor(), {"level": "y"},
            r"x along \+y, z along \+z; want plane='yz', and names that tell it, such as \(y, z\)$",
        ),
        (PlanarQuadrotor(), {"y": 0.7}, "at y = 0 m, where MuJoCo has body 'drone' at y = 0.7 m; want offset=0.7"),
        (PlanarQuadrotor(offset=0.7), {}, "at y = 0.7 m, where MuJoCo has body 'drone' at y = 0 m; want offset=0"),
    ],
)  # fmt: skip
def test_a_robot_of_another_plane_is_refused_with_the_remedy(robot, scene, message) -> None:
    with pytest.raises(ls.InputError, match=message):
        fitted(robot, **scene)


@settings(max_examples=examples(20))
@given(
    st.sampled_from([("x", "z"), ("y", "z"), ("a", "b")]), st.sampled_from(("x", "y")),
    st.floats(-3.0, 3.0).map(lambda number: round(number, 3)), st.sampled_from([None, "xz", "zx", "yz", "xy"]),
)  # fmt: skip
def test_who_follows_the_remedies_fits(names, level, y, plane) -> None:
    """At most three are needed: the plane, with its names, and where it is."""
    robot = PlanarQuadrotor(names=names, plane=plane if plane and names == ("a", "b") else "")
    for _ in range(4):
        try:
            fitted(robot, level=level, y=y)
            return
        except ls.InputError as refused:
            wants = dict(re.findall(r"(plane|offset)=('\w+'|[-\d.e]+)", str(refused).split("; want ")[1]))
            told = re.search(r"such as \((\w), (\w)\)", str(refused))
            changes = {name: value.strip("'") if name == "plane" else float(value) for name, value in wants.items()}
            robot = dataclasses.replace(robot, **changes | ({"names": told.groups()} if told else {}))
    pytest.fail(f"{robot} does not fit")


def test_a_plan_for_another_plane_is_not_run() -> None:
    below = PlanarQuadrotor(names=("a", "b"), plane="xz", offset=0.7)
    solution = track(PlanarQuadrotor(names=("a", "b")), np.zeros(6), np.full((5, 2), 2.45), 0.02)
    with pytest.raises(
        ls.InputError, match=r"\(a, b\) in the plane 'xy', want the position .*: \(a, b\) in the plane 'xz' at 0.7 m"
    ):
        ls.simulate(fitted(below, y=0.7), solution)


class Mirrored(PlanarQuadrotor):
    """With the height downward, as in aviation."""

    def configuration(self, state):
        qpos, qvel = super().configuration(np.asarray(state) * [1, -1, 1, 1, -1, 1])
        return qpos, qvel


class Millimetres(PlanarQuadrotor):
    def configuration(self, state):
        qpos, qvel = super().configuration(np.asarray(state) * 1e-3)
        return qpos, qvel


class Shifted(PlanarQuadrotor):
    def configuration(self, state):
        qpos, qvel = super().configuration(np.asarray(state) + 0.5 * np.eye(6)[0])
        return qpos, qvel


class Unfit(PlanarQuadrotor):
    def configuration(self, state):
        return np.zeros(2), np.zeros(3)


class Idle(PlanarQuadrotor):
    actuators = ()


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (Mirrored(), r"z along -z; want each to move it by a metre along its own axis"),
        (Millimetres(), r"x along \(0.001, 0, 0\), z along \(0, 0, 0.001\); want each to move it by a metre"),
        (
            Shifted(),
            r"got \(0, 0\) m in the plane 'xz', where MuJoCo has the origin of body 'drone' at \(0.5, 0, 0\) m",
        ),
        (Unfit(), r"configuration: qpos: got shape \(2,\), want \(3,\) for across, up, roll"),
        (Idle(), r"actuation: got shape \(2,\), want \(0,\) for no actuators"),
    ],
)
def test_a_robot_that_is_elsewhere_than_its_states_say_is_refused(robot, message) -> None:
    with pytest.raises(ls.InputError, match=message):
        fitted(robot)


def test_a_robot_in_space_has_its_axes_in_order() -> None:
    class Swapped(ls.Quadrotor):
        def configuration(self, state):
            return super().configuration(np.asarray(state)[..., [1, 0, *range(2, 12)]])

    # With such names the position is in this order, so configuration() has to change.
    with pytest.raises(ls.InputError, match=r"x along \+y, y along \+x, z along \+z; want each to move it by a metre"):
        ls.Plant(Swapped(), ls.load_scene("cage"))
    Swapped.configuration = ls.Quadrotor.configuration
    ls.Plant(Swapped(), ls.load_scene("cage"))


def test_a_position_of_other_names_follows_the_remedy_into_order() -> None:
    """A ball on three slides, whose first is along y."""
    text = sled("yxz", name="ball", names="abc")

    class Ball(Jointed):
        name, body, radius = "ball", "ball", 0.1
        joints = actuators = ("a", "b", "c")
        order: tuple[str, ...] = ("a", "b", "c")

        @property
        def dynamics(self):
            return ls.Dynamics(
                lambda x, u, p: [x.va, x.vb, x.vc, u.fa, u.fb, u.fc],
                states={"a": "m", "b": "m", "c": "m", "va": "m/s", "vb": "m/s", "vc": "m/s"},
                controls={"fa": "N", "fb": "N", "fc": "N"}, position=self.order,
            )  # fmt: skip

    ball = Ball()
    with pytest.raises(ls.InputError, match=r"want position=\('b', 'a', 'c'\)"):
        ls.Plant(ball, scene_from_xml(text, "ball"))
    Ball.order = ("b", "a", "c")
    ls.Plant(ball, scene_from_xml(text, "ball"))


@pytest.mark.parametrize("at", [0.4, -1.3])
def test_slides_that_count_from_the_body_s_place_are_told(at: float) -> None:
    """The body is elsewhere in the MJCF; a configuration() that takes that off fits."""
    scene = scene_from_xml(mjcf().replace('pos="0 0.0 0"', f'pos="{at} 0 0"'), "planar")
    with pytest.raises(ls.InputError, match=r"slides count from the body's pos in the MJCF"):
        ls.Plant(PlanarQuadrotor(), scene)

    class Placed(PlanarQuadrotor):
        def configuration(self, state):
            return super().configuration(np.asarray(state) - at * np.eye(6)[0])

        def state(self, qpos, qvel, near=None):
            return super().state(qpos, qvel) + at * np.eye(6)[0]

    ls.Plant(Placed(), scene)


# The robot among other bodies that move

BEFORE = """
<body name="pendulum" pos="0 1.5 0.5"><joint name="swing" type="hinge" axis="0 1 0"/>
  <geom name="bob" type="sphere" size="0.35" pos="0.3 0 -0.2"/></body>
"""


@draws
def test_it_is_the_robot_that_is_measured_and_not_what_moves_before_it_in_the_file(tmp_path: Path) -> None:
    robot = PlanarQuadrotor()
    plant = fitted(robot, things="", before=BEFORE)
    hover = planar_quadrotor.MASS * planar_quadrotor.GRAVITY / 2
    solution = track(robot, (0.0, 1.0, 0.0, 0.5, 0.0, 0.0), np.full((50, 2), hover), 0.02)
    rollout = ls.simulate(plant, solution)
    assert rollout.body == "drone"
    found = ls.verify_run(rollout, solution=solution)
    assert "silhouette of ball" in found.method
    assert found.passed, found
    video = ls.render(rollout, tmp_path / "run.mp4", camera="side", size=(640, 480), fps=10)
    assert ls.verify_video(video, rollout, solution=solution).passed
    assert ls.load(ls.save(rollout, tmp_path / "run.npz"), ls.Rollout).body == "drone"
    with pytest.raises(ls.InputError, match=r"rollout.body: got 'ghost', want the name of a body of the model"):
        ls.verify_run(dataclasses.replace(rollout, body="ghost"))


@pytest.mark.parametrize(("level", "names"), [("x", ("x", "z")), ("x", ("z", "x")), ("y", ("y", "z"))])
def test_predicted_trials_displace_obstacles_as_runs_do(level, names):
    """Across a vertical plane, too, where a ball beside the plane comes nearer to it."""
    robot = PlanarQuadrotor(names=names)
    problem = planar_quadrotor.problem(robot, scene_from_xml(mjcf(level=level), "planar").world)
    surroundings, rng = Surroundings.of(problem, 0.1), np.random.default_rng(0)
    predicted = surroundings.displacements(rng, 4000)[0]
    runs = surroundings.shapes[0].across(0.1 * rng.standard_normal(predicted.shape))
    np.testing.assert_allclose(predicted.std(axis=0), runs.std(axis=0), rtol=0.05)
