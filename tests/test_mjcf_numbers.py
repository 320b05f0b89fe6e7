"""Numbers of an MJCF by name: the same as the file with another number in it, and nothing compiles."""

import pickle
from dataclasses import replace
from typing import Any

import mechanisms
import numpy as np
import pytest
from mechanisms import NO_CONTACT, motors, row, scene, sled

import lqrsim as ls
from lqrsim.codegen import compiled_module
from lqrsim.errors import Array, InputError
from lqrsim.scenes.scene import scene_from_xml

# A cart that drags on the floor and carries a pole, which has a stiff hinge, a rotor and dry friction; a servo drives
# the pole. The attributes of the pole's joint come from a class, where they are not to be changed for others.
FILE = sled(
    "xz", name="cart", names=("slider", "lift"), place="0 0 0.098",
    geom='type="box" size="0.1 0.1 0.1" mass="{cart}" friction="{friction} 0.01 0.001"',
    carried=f"""<site name="hook" pos="0 0 0.1"/><body name="pole">
      <joint name="hinge" class="stiff" axis="0 1 0" armature="{{armature}}" frictionloss="{{loss}}"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="{{pole}}" {NO_CONTACT}/>
      <geom type="sphere" pos="0 0 0.5" size="0.05" mass="{{tip}}" {NO_CONTACT}/>
      <body name="vane" pos="0 0 0.5"><joint name="spin" class="stiff" axis="0 0 1"/>
        <geom type="box" size="0.1 0.01 0.1" density="300" {NO_CONTACT}/></body></body>""",
    things='<geom name="floor" type="plane" size="5 5 0.1" friction="0.1"/>',
    before='<default><default class="stiff"><joint stiffness="{stiffness}" damping="{damping}"/></default></default>',
    actuators='<motor name="pull" site="hook" gear="{gear}"/><position name="turn" joint="hinge" kp="2"/>',
    option='timestep="0.005" density="{density}" viscosity="{viscosity}"', compiler="{compiler}",
)  # fmt: skip
STATED: dict[str, Any] = {
    "density": 1.2, "viscosity": 0.01, "compiler": "", "stiffness": 0.5, "damping": "0.1 0.02", "cart": 1.0,
    "friction": 0.4, "armature": 0.01, "loss": 0.02, "pole": 0.2, "tip": 0.1, "gear": "2 0 0.5 0 0 0.1",
}  # fmt: skip
VANE = 300 * 0.2 * 0.02 * 0.2  # kg


def robot_of(**numbers: Any) -> ls.MjcfRobot:
    return ls.MjcfRobot(scene_from_xml(FILE.format(**STATED | numbers), "cart"), body="cart", position=())


def stepped(dynamics: ls.Dynamics) -> Array:
    """Some steps from rest on the floor, under forces that slide it."""
    rng = np.random.default_rng(0)
    states: list[Array] = [np.zeros(8)]
    for _ in range(20):
        states.append(dynamics.step(states[-1], [4 * rng.normal(), rng.normal()], 0.01))
    return np.array(states)


# What is asked for, and the file with other numbers that this is to be.
CASES: dict[str, tuple[dict[str, float], dict[str, Any]]] = {
    "pole_mass": ({"pole_mass": 0.9}, {"pole": 0.6, "tip": 0.3}),
    "cart_mass": ({"cart_mass": 0.7}, {"cart": 0.7}),
    "hinge_damping": ({"hinge_damping": 0.3, "spin_damping": 0.3}, {"damping": "0.3 0.02"}),
    "hinge_stiffness": ({"hinge_stiffness": 0.9, "spin_stiffness": 0.9}, {"stiffness": 0.9}),
    "hinge_armature": ({"hinge_armature": 0.03}, {"armature": 0.03}),
    "hinge_frictionloss": ({"hinge_frictionloss": 0.08}, {"loss": 0.08}),
    "cart_friction": ({"cart_friction": 0.9}, {"friction": 0.9}),
    "pull_gear": ({"pull_gear": 3.0}, {"gear": "3 0 0.75 0 0 0.15"}),
    "density": ({"density": 5.0}, {"density": 5.0}),
    "viscosity": ({"viscosity": 0.2}, {"viscosity": 0.2}),
    "several": ({"cart_mass": 0.7, "cart_friction": 0.9}, {"cart": 0.7, "friction": 0.9}),
}


@pytest.mark.parametrize("which", CASES)
def test_a_number_by_name_is_that_number_in_the_file(which: str) -> None:
    values, edited = CASES[which]
    robot, expected = robot_of(), stepped(robot_of(**edited).dynamics)
    assert np.abs(expected - stepped(robot.dynamics)).max() > 1e-5, "the number makes no difference"
    np.testing.assert_allclose(stepped(robot.dynamics.with_parameters(**values)), expected, rtol=0, atol=1e-12)
    changed = robot.with_parameters(**values)
    np.testing.assert_allclose(stepped(changed.dynamics), expected, rtol=0, atol=1e-12)
    found = changed.dynamics.numbers
    assert {name: found[name] for name in values} == pytest.approx(values, rel=1e-14)


def test_the_whole_mass_scales_all_bodies() -> None:
    robot, total = robot_of(), 1.3 + VANE
    assert robot.dynamics.numbers["mass"] == pytest.approx(total, rel=1e-12)
    expected = robot_of(compiler=f'settotalmass="{2 * total!r}"').scene.model
    model = robot.with_parameters(mass=2 * total).scene.model
    np.testing.assert_allclose(model.body_mass, expected.body_mass, rtol=1e-12)
    np.testing.assert_allclose(model.body_inertia, expected.body_inertia, rtol=1e-12)
    # What MuJoCo derives of them when it compiles.
    np.testing.assert_allclose(model.dof_invweight0, expected.dof_invweight0, rtol=1e-12)


@pytest.mark.parametrize("compiler", ['inertiafromgeom="true"', 'settotalmass="9"', 'boundmass="0.5"'])
def test_masses_however_they_came_about(compiler: str) -> None:
    """A body with another mass leaves the others theirs; MuJoCo's masses and inertias, before and after."""
    robot = robot_of(compiler=compiler)
    before, after = robot.scene.model, robot.with_parameters(pole_mass=0.05).scene.model
    scale = np.where(np.arange(4) == before.body("pole").id, 0.05 / before.body("pole").mass, 1.0)
    np.testing.assert_allclose(after.body_mass, scale * before.body_mass, rtol=1e-12)
    np.testing.assert_allclose(after.body_inertia, scale[:, None] * before.body_inertia, rtol=1e-12)
    np.testing.assert_allclose(after.body_ipos, before.body_ipos, atol=1e-15)
    np.testing.assert_allclose(after.body_iquat, before.body_iquat, atol=1e-15)


# A free body that MuJoCo gives the axes of its inertia; geoms are where they are on it, whatever its mass is.
ALIGNED = scene(
    """<body name="stone" pos="0 0 1" euler="{turn}">{joint}<geom size="0.1" pos="{place}" mass="{b}"/>
    <geom type="capsule" size="0.05" fromto="0 0 0 1 0 0" mass="{a}"/></body>""",
    '<motor name="pull" joint="free" gear="1 0 0 0 0 0"/>',
    compiler='alignfree="{all}"',
)
ALIGNING = {
    "its own": {"joint": '<freejoint name="free" align="true"/>'},
    "of all": {"joint": '<freejoint name="free"/>', "all": "true"},
    "of all joints": {"joint": '<joint type="free" name="free"/>', "all": "true"},
    "none": {"joint": '<freejoint name="free"/>'},
}


@pytest.mark.parametrize("aligning", ALIGNING)
@pytest.mark.parametrize("seed", range(3))
def test_a_free_body_of_another_mass_keeps_its_shape_where_mujoco_aligns_it(aligning: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, place = (" ".join(map(str, rng.uniform(-1, 1, 3))) for _ in range(2))
    stated = {"all": "false", "turn": turn, "place": place, **ALIGNING[aligning]}
    robot, expected = (
        ls.MjcfRobot(scene_from_xml(ALIGNED.format(**stated, a=scale * 0.5, b=scale * 0.2), "stone"))
        for scale in (1, 3)
    )
    model, wanted = robot.with_parameters(stone_mass=2.1).scene.model, expected.scene.model
    assert (np.abs(wanted.body_ipos).max() < 1e-9) == (aligning != "none"), "it is not aligned"
    for field in ("body_pos", "body_ipos", "body_mass", "body_inertia", "geom_pos"):
        np.testing.assert_allclose(getattr(model, field), getattr(wanted, field), atol=1e-12, err_msg=field)


# A spring of a frequency, and servos of a damping ratio, which MuJoCo computes from masses.
DAMPED = row(
    ["hinge"], joint='axis="0 1 0" armature="0.1" {spring}', geom='type="capsule" size="0.05" fromto="0 0 0 1 0 0"',
    before="<default>{of_class}</default>", actuators='<{servo} name="turn" joint="hinge" {damping}/>',
)  # fmt: skip
DAMPERS = {
    "spring": {"spring": 'springdamper="0.5 0.3"', "servo": "motor"},
    "spring of a class": {"of_class": '<joint springdamper="0.5 0.3"/>', "servo": "motor"},
    "position": {"servo": "position", "damping": 'kp="9" dampratio="0.7"'},
    "position of a class": {"of_class": '<position dampratio="0.7"/>', "servo": "position", "damping": 'kp="9"'},
    "integrated": {"servo": "intvelocity", "damping": 'kp="9" dampratio="0.7" actrange="-1 1"'},
    "general": {"servo": "general", "damping": 'gainprm="9" biastype="affine" biasprm="0 -9 0.7"'},
    "spring and servo": {"spring": 'springdamper="0.5 0.3"', "servo": "position", "damping": 'kp="9" dampratio="1"'},
}
CHANGES = [
    {"mass": 3.0},
    {"hinge_mass": 20.0},
    {"hinge_stiffness": 2.0},
    {"hinge_damping": 1.5},
    {"hinge_armature": 0.3},
]


@pytest.mark.parametrize("damper", DAMPERS)
@pytest.mark.parametrize("change", CHANGES, ids=str)
def test_a_number_is_changed_and_no_other_where_mujoco_computes_them(damper: str, change: dict[str, float]) -> None:
    stated = {"of_class": "", "spring": "", "damping": ""} | DAMPERS[damper]
    robot = ls.MjcfRobot(scene_from_xml(DAMPED.format(**stated), "arm"))
    changed = robot.with_parameters(**change)
    expected = robot.dynamics.numbers | change
    mass = change.get("mass", change.get("hinge_mass", expected["mass"]))
    assert changed.dynamics.numbers == pytest.approx(expected | {"mass": mass, "hinge_mass": mass}, rel=1e-12)
    for field in ("actuator_biasprm", "actuator_gainprm"):
        before, after = (getattr(of.scene.model, field) for of in (robot, changed))
        np.testing.assert_allclose(after, before, rtol=1e-12, err_msg=field)


@pytest.mark.parametrize(
    "others", ["", '<motor name="pull" joint="lift" gear="2"/>', '<position name="p" joint="lift"/>']
)
def test_all_numbers_of_a_robot_that_sticks_can_be_changed(others: str) -> None:
    """Adhesion has a gear in the model, but none in the text."""
    xml = sled(
        "z", names=["lift"], name="foot", place="0 0 0.1", things='<geom name="floor" type="plane" size="1 1 0.1"/>',
        actuators=f'<adhesion name="stick" body="foot" ctrlrange="0 1" gain="3"/>{others}', option="",
    )  # fmt: skip
    robot = ls.MjcfRobot(scene_from_xml(xml, "foot"), position=())
    for name, number in robot.dynamics.numbers.items():
        assert robot.dynamics.with_parameters(**{name: number + 1.0}).numbers[name] == pytest.approx(number + 1.0)


def test_changes_add_up_and_the_first_keeps_its_own() -> None:
    dynamics = robot_of().dynamics
    before, data = stepped(dynamics), dynamics.numbers
    heavy = dynamics.with_parameters(cart_mass=3.0).with_parameters(cart_friction=0.2)
    np.testing.assert_allclose(stepped(heavy), stepped(robot_of(cart=3.0, friction=0.2).dynamics), atol=1e-12)
    np.testing.assert_array_equal(stepped(dynamics), before)
    assert dynamics.numbers == data
    assert len({dynamics.model_digest, heavy.model_digest, dynamics.with_parameters(cart_mass=3.0).model_digest}) == 3
    again = pickle.loads(pickle.dumps(heavy))
    np.testing.assert_array_equal(stepped(again), stepped(heavy))
    assert (again.numbers, again.model_digest) == (heavy.numbers, heavy.model_digest)


def test_what_is_pushed_has_them_too() -> None:
    robot, edited = robot_of(), robot_of(cart=3.0)
    pushed = robot.dynamics.disturbed.with_parameters(force_x=2.0, cart_mass=3.0)
    np.testing.assert_allclose(stepped(pushed), stepped(edited.dynamics.disturbed.with_parameters(force_x=2.0)))
    assert np.abs(stepped(pushed) - stepped(edited.dynamics)).max() > 1e-3
    assert pushed.with_parameters(cart_mass=1.0).parameters["force_x"] == 2.0


def swing(robot: ls.MjcfRobot) -> ls.Problem:
    """A hanging pole, brought to rest below its cart."""
    return ls.Problem(
        dynamics=robot.dynamics, dt=0.02, steps=60, initial=ls.FixedState(robot.at(pole=2.5)),
        stage_cost=ls.ControlCost([0.1]), final_cost=ls.QuadraticCost(np.full(4, 50.0), about=robot.at(pole=np.pi)),
    )  # fmt: skip


def test_a_problem_takes_them_and_compiles_nothing() -> None:
    robot = ls.MjcfRobot(scene_from_xml(mechanisms.draw("cart", 4, "implicitfast").xml, "cart"))
    problem, plant = swing(robot), ls.Plant(robot, robot.scene)
    before = ls.smooth(problem)
    ls.simulate(plant, before)
    made = len(compiled_module.compilations)
    values = {"cart_mass": 2 * robot.dynamics.numbers["cart_mass"], "pole_damping": 0.05}
    changed = robot.with_parameters(**values)
    solution = ls.smooth(replace(problem, dynamics=robot.dynamics.with_parameters(**values)))
    rollout = ls.simulate(ls.Plant(changed, changed.scene), solution)
    unaware = ls.simulate(ls.Plant(changed, changed.scene), before)
    assert compiled_module.compilations[made:] == []
    assert solution.success, solution
    assert solution.problem_digest not in (before.problem_digest, problem.digest)
    assert solution.problem_digest == swing(changed).digest
    # The plan is what the plant with these numbers does, and the plan without them is not.
    np.testing.assert_allclose(rollout.states[0], solution.trajectory.states, rtol=0, atol=1e-6)
    assert np.abs(unaware.states[0] - before.trajectory.states).max() > 0.01


def test_the_robot_keeps_what_it_was_told() -> None:
    drone = ls.MjcfRobot("cage", radius=0.2, floors=False)
    changed = drone.with_parameters(quadrotor_mass=0.6)
    space = drone.dynamics.state_coordinates
    assert (changed.radius, changed.body, changed.name) == (0.2, drone.body, drone.name)
    assert changed.dynamics.state_coordinates == space
    np.testing.assert_allclose(changed.scene.model.body("quadrotor").mass, [0.6], rtol=1e-15)
    # A hovering rotor carries a quarter of the weight, by hand.
    gravity = -changed.scene.model.opt.gravity[2]
    after = changed.dynamics.step(changed.at(), np.full(4, 0.6 * gravity / 4), 1 / 30)
    np.testing.assert_allclose(after, changed.at(), atol=1e-12)


def test_bodies_that_the_text_does_not_have_keep_their_masses() -> None:
    """Replicas have names that the text has not: their masses have no place in it, and nobody's is changed."""
    part = '<body name="{}"><joint name="{}" type="slide"/><geom size="0.1" mass="1"/></body>'
    world = part.format("single", "slide") + f'<replicate count="2">{part.format("twin", "own")}</replicate>'
    dynamics = ls.MjcfRobot(scene_from_xml(scene(world, motors(["slide"])), "twins")).dynamics
    assert dynamics.physics.model.nbody == 4
    assert "slide_damping" in dynamics.numbers
    assert not [name for name in dynamics.numbers if name.endswith("mass")]


def test_what_it_cannot_be_is_said_in_one_line() -> None:
    robot = robot_of()
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"pole_mas": 1.0}, r"cart: parameters: got 'pole_mas', want one of: mass, .*did you mean pole_mass"),
        ({"floor_friction": -1.0}, r"floor_friction: got -1.0, want a finite number >= 0"),
        ({"mass": 0.0}, r"mass: got 0.0, want a finite number > 0"),
        ({"mass": -1.0}, r"mass: got -1.0, want a finite number > 0"),
        ({"cart_mass": np.nan}, r"cart_mass: got nan, want a finite number > 0"),
        ({"turn_gear": np.inf}, r"turn_gear: got inf, want a finite number"),
        ({"hinge_damping": "much"}, r"hinge_damping: got 'much', want a finite number >= 0"),
        ({"mass": 2.0, "pole_mass": 1.0}, r"mass: got mass and pole_mass, want one of the two"),
        ({"force_x": 1.0}, r"parameters: got 'force_x', want one of: mass"),
    )
    for values, message in cases:
        for taker in (robot, robot.dynamics):
            with pytest.raises(InputError, match=message):
                taker.with_parameters(**values)
