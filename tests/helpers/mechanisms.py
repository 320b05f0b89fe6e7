"""Robots and MJCFs that tests share, where what they are made of is not the point."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.random import Generator

import lqrsim as ls

NO_CONTACT = 'contype="0" conaffinity="0"'  # of a geom that touches nothing


class Jointed(ls.Robot):
    """A robot whose states are its joints' positions and speeds."""

    radius = 0.1

    def state(self, qpos, qvel, near=None):
        state = np.concatenate([qpos, qvel], axis=-1)
        return state if near is None else self.dynamics.state_coordinates.nearest(state, near)

    def configuration(self, state):
        qpos, qvel = np.split(np.asarray(state, dtype=float), 2, axis=-1)
        return qpos, qvel


def motors(joints: Sequence[str], limits: Sequence[float] = ()) -> str:
    """A motor for each joint, of the same name; with limits, its largest force or torque."""
    ranges = [f'ctrlrange="-{most} {most}"' for most in limits] or [""] * len(joints)
    return "".join(f'<motor name="{one}" joint="{one}" {most}/>' for one, most in zip(joints, ranges, strict=True))


def scene(
    bodies: str, actuators: str = "", *, option: str = "", compiler: str = 'angle="radian"', before: str = "",
    things: str = "", more: str = "",
) -> str:  # fmt: skip
    """An MJCF of these bodies and of things that are fixed; `before` and `more` are sections before and after them."""
    return f"""<mujoco><option {option}/><compiler {compiler}/>{before}
      <worldbody>{things}{bodies}</worldbody>{more}<actuator>{actuators}</actuator></mujoco>"""


def arm(
    *lengths: float,
    names: Sequence[str] = "abc",
    joint: str = 'axis="0 1 0" damping="0.5" armature="0.02"',
    joints: Sequence[str] = ("", "", ""),
    geom: str = f'size="0.03" {NO_CONTACT}',
    geoms: Sequence[str] = ("", "", ""),
    along: Sequence[float] = (1, 0, 0),
    gap: float = 0.0,
    place: str = "0 0 0",
    end: str = "",
    limits: Sequence[float] = (),
    actuators: str = "",
    before: str = "",
    option: str = 'timestep="0.01" integrator="implicitfast"',
    **more: str,
) -> str:
    """Capsules in a line, each hinged to the end of the one before; `gap` is from a hinge to where its capsule begins.

    `joint` and `geom` are attributes of all, `joints` and `geoms` those of each. Without actuators there are motors.
    """

    def at(far: float) -> str:
        return " ".join(str(far * one + 0.0) for one in along)

    bodies = end
    for k in reversed(range(len(lengths))):
        bodies = f"""<body name="{("upper", "fore", "hand")[k]}" pos="{at(lengths[k - 1]) if k else place}">
          <joint name="{names[k]}" class="link" {joints[k]}/>
          <geom class="link" type="capsule" fromto="{at(gap)} {at(lengths[k])}" {geoms[k]}/>{bodies}</body>"""
    default = f'<default><default class="link"><joint {joint}/><geom {geom}/></default></default>'
    driven = actuators or motors(names[: len(lengths)], limits)
    return scene(bodies, driven, before=default + before, option=option, **more)


def sled(
    axes: str = "x",
    *,
    name: str = "sled",
    names: Sequence[str] = (),
    joint: str = "",
    geom: str = 'type="sphere" size="0.1" mass="1"',
    place: str = "0 0 0",
    carried: str = "",
    limits: Sequence[float] = (),
    actuators: str = "",
    option: str = 'timestep="0.01" gravity="0 0 0"',
    **more: str,
) -> str:
    """A body, with a geom of the same name, that slides along these axes and carries others, or joints of its own.

    Joints have these names, by default those of the axes, and so have motors.
    """
    names = names or tuple(axes)
    slides = "".join(
        f'<joint name="{own}" type="slide" axis="{" ".join("01"[axis == one] for one in "xyz")}" {joint}/>'
        for own, axis in zip(names, axes, strict=True)
    )
    body = f'<body name="{name}" pos="{place}">{slides}<geom name="{name}" {geom}/>{carried}</body>'
    return scene(body, actuators or motors(names, limits), option=option, **more)


def row(
    names: Sequence[str],
    *,
    joint: str = 'axis="0 1 0"',
    joints: Sequence[str] = (),
    geom: str = f'size="0.1" {NO_CONTACT}',
    geoms: Sequence[str] = (),
    places: Sequence[str] = (),
    carried: Sequence[str] = (),
    actuators: str = "",
    **more: str,
) -> str:
    """Bodies beside one another, a metre apart or at these places, each on a joint of the same name."""
    bodies = "".join(
        f'<body name="{name}" pos="{place or f"0 {k} 0"}"><joint name="{name}" {joint} {turn}/>'
        f"<geom {geom} {shape}/>{on}</body>"
        for k, (name, turn, shape, place, on) in enumerate(
            zip_longest(names, joints, geoms, places, carried, fillvalue="")
        )
    )
    return scene(bodies, actuators, **more)


# A free body with a ball joint and a hinge: its links move in other coordinates than MuJoCo's. {link} is the last
# link's geom, {more} what else is in or on the body.
FLOATING = scene(
    """<body name="hull"><freejoint/><geom size="0.1"/>
      <body name="upper" pos="0.2 0 0"><joint type="ball"/><geom type="capsule" size="0.03" fromto="0.05 0 0 0.2 0 0"/>
        <body name="fore" pos="0.25 0 0"><joint name="elbow" axis="0 1 0.3"/><geom {link}/>
          <site name="tip" pos="0.1 0 0" euler="0 20 0"/></body></body>{more}</body>""",
    '<motor joint="elbow"/>{motors}', things="{things}", compiler="",
    before='<asset><mesh name="rock" vertex="0 0 .2  .1 0 0  0 .1 0  -.1 0 0  0 -.1 0  0 0 -.2"/></asset>',
)  # fmt: skip


# Small MJCFs with all kinds of joints, actuators and integrators, and random numbers.


@dataclass(frozen=True)
class Drawn:
    """An MJCF as text, and how many physics steps there are in a control period."""

    xml: str
    substeps: int
    integrator: str


def draw(kind: str, seed: int, integrator: str | None = None) -> Drawn:
    """A random MJCF of one kind, with any of MuJoCo's integrators."""
    rng = np.random.default_rng(seed)
    chosen = integrator or INTEGRATORS[int(rng.integers(len(INTEGRATORS)))]
    xml = KINDS[kind](rng, f'timestep="0.005" integrator="{chosen}"')
    return Drawn(xml, int(rng.integers(1, 5)), chosen)


def _cart(rng: Generator, option: str) -> str:
    """A slide that carries a hinge, one motor; a limit that a state may be beyond."""
    return sled(
        name="cart", names=["slider"], joint=f'range="-0.3 0.3" damping="{rng.uniform(0, 1):.4f}"',
        geom=f'type="box" size="0.1 0.1 0.1" mass="{rng.uniform(0.5, 2):.4f}"',
        carried=f"""<body name="pole"><joint name="pole" axis="0 1 0" damping="{rng.uniform(0, 0.1):.4f}"/>
          <geom type="capsule" fromto="0 0 0 0 0 {rng.uniform(0.2, 0.6):.4f}" size="0.02" mass="0.2" {NO_CONTACT}/>
          </body>""",
        actuators=f'<motor name="push" joint="slider" gear="{rng.uniform(1, 5):.4f}" ctrlrange="-1 1"/>', option=option,
    )  # fmt: skip


def _arm(rng: Generator, option: str) -> str:
    """A ball joint that carries a hinge, a servo of position and one of velocity for the hinge."""
    upper = f'<joint name="shoulder" type="ball" damping="{rng.uniform(0, 0.2):.4f}"/>'
    upper += f'<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="{rng.uniform(0.5, 2):.4f}"/>'
    lower = """<body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3"/></body>"""
    servos = f"""<position name="bend" joint="elbow" kp="{rng.uniform(1, 5):.4f}"/>
      <velocity name="turn" joint="elbow" kv="{rng.uniform(0.1, 1):.4f}"/>"""
    return scene(f'<body name="upper">{upper}{lower}</body>', servos, option=option)


def _box(rng: Generator, option: str) -> str:
    """A free box near the floor, or in it, pushed along two of its own axes."""
    return sled(
        "", name="box", place="0 0 0.5", carried='<freejoint/><site name="middle"/>', option=option,
        geom=f'type="box" size="0.2 0.15 0.1" mass="{rng.uniform(0.5, 2):.4f}" friction="{rng.uniform(0.3, 1):.4f}"',
        things='<geom name="floor" type="plane" size="5 5 0.1"/>',
        actuators='<motor site="middle" gear="0 0 1 0 0 0"/><motor site="middle" gear="0 0 0 0 1 0"/>',
    )  # fmt: skip


def _wheel(rng: Generator, option: str) -> str:
    """A hinge driven through a first-order lag: the actuator has a state."""
    return row(
        ["axle"], joint=f'axis="0 0 1" damping="{rng.uniform(0.01, 0.1):.4f}"',
        geom=f'type="cylinder" size="0.2 0.02" mass="{rng.uniform(0.5, 2):.4f}"', option=option,
        actuators=f"""<general name="drive" joint="axle" dyntype="filter" dynprm="{rng.uniform(0.02, 0.2):.4f}"
          gainprm="1" ctrlrange="-2 2"/>""",
    )  # fmt: skip


def _rig(rng: Generator, option: str) -> str:
    """Two levers and a towed body with any of what ties them: equalities, a mocap body, tendons, springs, friction.

    The actuators are two of many kinds, with and without states, on joints, on tendons, or with gains that depend on
    the velocity.
    """
    levers = "".join(
        f"""<body name="{name}" pos="{x} 0 0"><joint name="{name}" type="{rng.choice(["hinge", "slide"])}" axis="0 1 0"
          damping="{rng.uniform(0.1, 1):.4f}" stiffness="{rng.choice([0, 2])}" frictionloss="{rng.choice([0, 0, 0.1])}"
          armature="0.05"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0" conaffinity="0"/>
          <site name="{name}" pos="0.3 0 0"/></body>"""
        for name, x in (("left", 0.0), ("right", 0.5))
    )
    ties = {
        "joint": '<joint joint1="right" joint2="left" polycoef="0 0.5 0.1 0 0"/>',
        "connect": '<connect body1="towed" body2="hand" anchor="0.1 0 0"/>',
        "tendon": '<tendon tendon1="belt" polycoef="0.1 0 0 0 0"/>',
    }
    chosen = [tie for tie in ties.values() if rng.random() < 0.4]
    drives = (
        '<motor name="{}" joint="left" gear="3"/>',
        '<position name="{}" joint="right" kp="20" kv="1" timeconst="0.05"/>',
        '<intvelocity name="{}" joint="left" kp="10" actrange="-1 1"/>',
        '<damper name="{}" joint="right" kv="2" ctrlrange="0 1"/>',
        '<velocity name="{}" tendon="belt" kv="2"/>',
        '<general name="{}" tendon="rope" dyntype="filterexact" dynprm="0.03" gainprm="2"/>',
        '<muscle name="{}" tendon="rope" ctrlrange="0 1" lengthrange="0.1 1.5" force="5"/>',
    )
    driven = "".join(drives[i].format(f"drive{k}") for k, i in enumerate(rng.choice(len(drives), 2, replace=False)))
    towed = f"""<body name="hand" mocap="true" pos="0 0.3 0"/>{levers}
      <body name="towed" pos="0 0.3 0"><joint name="towed" type="free" damping="0.1"/>
        <geom type="box" size="0.1 0.05 0.03" mass="{rng.uniform(0.5, 2):.4f}" {NO_CONTACT}/></body>"""
    more = f"""<tendon><fixed name="belt" stiffness="{rng.choice([0, 3])}" damping="0.1">
        <joint joint="left" coef="0.7"/><joint joint="right" coef="-0.4"/></fixed>
      <spatial name="rope" stiffness="{rng.choice([0, 5])}"><site site="left"/><site site="right"/></spatial></tendon>
      <equality>{"".join(chosen)}</equality>"""
    return scene(towed, driven, more=more, option=option)


INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast", "discrete")
KINDS = {"cart": _cart, "arm": _arm, "box": _box, "wheel": _wheel, "rig": _rig}
