"""Robots and MJCFs that tests share, where what they are made of is not the point."""

from collections.abc import Sequence

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


def scene(bodies: str, actuators: str, *, option: str, things: str = "", more: str = "", default: str = "") -> str:
    return f"""<mujoco><option {option}/><compiler angle="radian" autolimits="true"/>{default}
      <worldbody>{things}{bodies}</worldbody>{more}<actuator>{actuators}</actuator></mujoco>"""


def arm(
    *lengths: float,
    names: Sequence[str] = "abc",
    joint: str = 'axis="0 1 0" damping="0.5" armature="0.02"',
    joints: Sequence[str] = ("", "", ""),
    geom: str = f'size="0.03" {NO_CONTACT}',
    geoms: Sequence[str] = ("", "", ""),
    gap: float = 0.0,
    place: str = "0 0 0",
    end: str = "",
    limits: Sequence[float] = (),
    actuators: str = "",
    option: str = 'timestep="0.01" integrator="implicitfast"',
    things: str = "",
    more: str = "",
) -> str:
    """Capsules along x, each hinged to the end of the one before; `gap` is from a hinge to where its capsule begins.

    `joint` and `geom` are attributes of all, `joints` and `geoms` those of each. Without actuators there are motors.
    """
    bodies = end
    for k in reversed(range(len(lengths))):
        at = f"{lengths[k - 1]} 0 0" if k else place
        bodies = f"""<body name="{("upper", "fore", "hand")[k]}" pos="{at}">
          <joint name="{names[k]}" class="link" {joints[k]}/>
          <geom class="link" type="capsule" fromto="{gap} 0 0 {lengths[k]} 0 0" {geoms[k]}/>{bodies}</body>"""
    default = f'<default><default class="link"><joint {joint}/><geom {geom}/></default></default>'
    driven = actuators or motors(names[: len(lengths)], limits)
    return scene(bodies, driven, option=option, things=things, more=more, default=default)


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
    things: str = "",
    more: str = "",
) -> str:
    """A body, with a geom of the same name, that slides along these axes and carries others.

    Joints have these names, by default those of the axes, and so have motors.
    """
    names = names or tuple(axes)
    slides = "".join(
        f'<joint name="{own}" type="slide" axis="{" ".join("01"[axis == one] for one in "xyz")}" {joint}/>'
        for own, axis in zip(names, axes, strict=True)
    )
    body = f'<body name="{name}" pos="{place}">{slides}<geom name="{name}" {geom}/>{carried}</body>'
    return scene(body, actuators or motors(names, limits), option=option, things=things, more=more)


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
