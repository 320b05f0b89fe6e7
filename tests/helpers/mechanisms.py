"""Robots and MJCFs that tests share, where what they are made of is not the point."""

from collections.abc import Sequence
from itertools import zip_longest

import numpy as np

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
FLOATING = """<mujoco>
  <asset><mesh name="rock" vertex="0 0 .2  .1 0 0  0 .1 0  -.1 0 0  0 -.1 0  0 0 -.2"/></asset>
  <worldbody>{things}
    <body name="hull"><freejoint/><geom size="0.1"/>
      <body name="upper" pos="0.2 0 0"><joint type="ball"/><geom type="capsule" size="0.03" fromto="0.05 0 0 0.2 0 0"/>
        <body name="fore" pos="0.25 0 0"><joint name="elbow" axis="0 1 0.3"/><geom {link}/>
          <site name="tip" pos="0.1 0 0" euler="0 20 0"/></body></body>{more}</body>
  </worldbody>
  <actuator><motor joint="elbow"/>{motors}</actuator>
</mujoco>"""
