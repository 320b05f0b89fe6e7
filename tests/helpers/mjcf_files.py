"""Small MJCFs with all kinds of joints, actuators and integrators, and random numbers."""

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast", "discrete")


@dataclass(frozen=True)
class Drawn:
    """An MJCF as text, and how many physics steps there are in a control period."""

    xml: str
    substeps: int
    integrator: str


def cart(rng: Generator) -> str:
    """A slide that carries a hinge, one motor; a limit that a state may be beyond."""
    return f"""
      <worldbody><body name="cart"><joint name="slider" type="slide" axis="1 0 0" range="-0.3 0.3" limited="true"
          damping="{rng.uniform(0, 1):.4f}"/><geom type="box" size="0.1 0.1 0.1" mass="{rng.uniform(0.5, 2):.4f}"/>
        <body name="pole"><joint name="pole" axis="0 1 0" damping="{rng.uniform(0, 0.1):.4f}"/>
          <geom type="capsule" fromto="0 0 0 0 0 {rng.uniform(0.2, 0.6):.4f}" size="0.02" mass="0.2" contype="0"
            conaffinity="0"/></body></body></worldbody>
      <actuator><motor name="push" joint="slider" gear="{rng.uniform(1, 5):.4f}" ctrlrange="-1 1"/></actuator>"""


def arm(rng: Generator) -> str:
    """A ball joint that carries a hinge, a servo of position and one of velocity for the hinge."""
    return f"""
      <worldbody><body name="upper"><joint name="shoulder" type="ball" damping="{rng.uniform(0, 0.2):.4f}"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="{rng.uniform(0.5, 2):.4f}"/>
        <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.05"/>
          <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.3"/></body></body></worldbody>
      <actuator><position name="bend" joint="elbow" kp="{rng.uniform(1, 5):.4f}"/>
        <velocity name="turn" joint="elbow" kv="{rng.uniform(0.1, 1):.4f}"/></actuator>"""


def box(rng: Generator) -> str:
    """A free box near the floor, or in it, pushed along two of its own axes."""
    return f"""
      <worldbody><geom name="floor" type="plane" size="5 5 0.1"/>
        <body name="box" pos="0 0 0.5"><freejoint/><geom type="box" size="0.2 0.15 0.1"
          mass="{rng.uniform(0.5, 2):.4f}" friction="{rng.uniform(0.3, 1):.4f}"/><site name="middle"/></body>
      </worldbody>
      <actuator><motor site="middle" gear="0 0 1 0 0 0"/><motor site="middle" gear="0 0 0 0 1 0"/></actuator>"""


def wheel(rng: Generator) -> str:
    """A hinge driven through a first-order lag: the actuator has a state."""
    return f"""
      <worldbody><body name="wheel"><joint name="axle" axis="0 0 1" damping="{rng.uniform(0.01, 0.1):.4f}"/>
        <geom type="cylinder" size="0.2 0.02" mass="{rng.uniform(0.5, 2):.4f}"/></body></worldbody>
      <actuator><general name="drive" joint="axle" dyntype="filter" dynprm="{rng.uniform(0.02, 0.2):.4f}"
        gainprm="1" ctrlrange="-2 2"/></actuator>"""


def rig(rng: Generator) -> str:
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
    return f"""
      <worldbody><body name="hand" mocap="true" pos="0 0.3 0"/>{levers}
        <body name="towed" pos="0 0.3 0"><joint name="towed" type="free" damping="0.1"/><geom type="box"
          size="0.1 0.05 0.03" mass="{rng.uniform(0.5, 2):.4f}" contype="0" conaffinity="0"/></body></worldbody>
      <tendon><fixed name="belt" stiffness="{rng.choice([0, 3])}" damping="0.1"><joint joint="left" coef="0.7"/>
          <joint joint="right" coef="-0.4"/></fixed>
        <spatial name="rope" stiffness="{rng.choice([0, 5])}"><site site="left"/><site site="right"/></spatial></tendon>
      <equality>{"".join(chosen)}</equality>
      <actuator>{driven}</actuator>"""


KINDS = {"cart": cart, "arm": arm, "box": box, "wheel": wheel, "rig": rig}


def draw(kind: str, seed: int, integrator: str | None = None) -> Drawn:
    """A random MJCF of one kind, with any of MuJoCo's integrators."""
    rng = np.random.default_rng(seed)
    chosen = integrator or INTEGRATORS[int(rng.integers(len(INTEGRATORS)))]
    options = f'<option timestep="0.005" integrator="{chosen}"/><compiler autolimits="true"/>'
    return Drawn(f'<mujoco model="{kind}">{options}{KINDS[kind](rng)}</mujoco>', int(rng.integers(1, 5)), chosen)
