"""An arm of three links goes round posts, every link clear of them: by its plan, and by MuJoCo's own distances.

    python experiments/three_link_arm.py            # the table, runs/three_link_arm/arm.mp4 and arm.png
    python experiments/three_link_arm.py --quick    # the table, of fewer trials

The links are 0.4 m long, move in a level plane, and are driven by torques against damping; their dynamics are those of
three rigid bodies. Stretched out, the arm would sweep through all the posts: it has to fold up between them. The plan
knows of it by spheres along each link (`Capsule`, `CollisionSpheres`), costs and constraints are of all of them, and
the search begins with paths of the joints. MuJoCo's distance between geoms, of capsules and posts, says whether it was
right.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from runner import FolderSettings, opening, run

import lqrsim as ls
from lqrsim.errors import Array

LENGTH, RADIUS, HEIGHT = 0.4, 0.03, 0.15  # m: of a link without its round ends, and where the plane is
MASS, INERTIA = 0.6, 0.6 * 0.4**2 / 12  # of a link, kg and kg m^2, in whose middle its mass is
ROTOR, DAMPING, TORQUE = 0.02, 0.4, 2.0  # of a joint: kg m^2, N m s; the most that its motor can do, N m
LINK = ls.types.Capsule(LENGTH, RADIUS, 0.002)
JOINTS = ("shoulder", "elbow", "wrist")
POSTS = {"first": (0.45, -0.55), "second": (0.6, 0.05), "third": (0.35, 0.6), "fourth": (-0.25, 0.65)}
POST, MARGIN = 0.04, 0.02  # m: their radius, and what is to be left between links and posts at the steps
START, GOAL = (-1.15, 0.1, 0.1), (2.6, 0.3, -0.2)  # rad


def places(x: Any, p: Any) -> list[list[Any]]:
    """Centers of the balls of all links, from the shoulder on."""
    from sympy import cos, sin

    joint, angle, found = [0, 0, HEIGHT], 0, []
    for turn in x[:3]:
        angle = angle + turn
        end = [joint[0] + p.length * cos(angle), joint[1] + p.length * sin(angle), HEIGHT]
        found += LINK.between(joint, end)
        joint = end
    return found


def motion(x: Any, u: Any, p: Any) -> list[Any]:
    """Three rigid rods, in the angles that they have in the world: M(angles) accelerations = torques."""
    from sympy import cos, sin

    at, speed = [x[0], x[0] + x[1], x[0] + x[1] + x[2]], [x[3], x[3] + x[4], x[3] + x[4] + x[5]]
    joint = [u[i] - p.damping * x[3 + i] for i in range(3)]
    torque = [joint[0] - joint[1], joint[1] - joint[2], joint[2]]
    rods = p.mass * p.length**2
    # Of rods i and j, how many half lengths the mass beyond counts: a rod's own is in its middle.
    share = [[(2 - max(i, j) + (0.25 if i == j else 0.5)) * rods for j in range(3)] for i in range(3)]
    mass = [[share[i][j] * cos(at[i] - at[j]) for j in range(3)] for i in range(3)]
    for i in range(3):
        mass[i][i] = share[i][i] + p.inertia + p.rotor * (2 if i < 2 else 1)
        torque[i] -= sum(share[i][j] * sin(at[i] - at[j]) * speed[j] ** 2 for j in range(3) if j != i)
    for i in range(2):  # a rotor turns with the difference of its two links
        mass[i][i + 1] -= p.rotor
        mass[i + 1][i] -= p.rotor
    cofactor = [
        [
            mass[(j + 1) % 3][(i + 1) % 3] * mass[(j + 2) % 3][(i + 2) % 3]
            - mass[(j + 1) % 3][(i + 2) % 3] * mass[(j + 2) % 3][(i + 1) % 3]
            for j in range(3)
        ]
        for i in range(3)
    ]
    determinant = sum(mass[0][j] * cofactor[j][0] for j in range(3))
    turn = [sum(cofactor[i][j] * torque[j] for j in range(3)) / determinant for i in range(3)]
    return [*x[3:], turn[0], turn[1] - turn[0], turn[2] - turn[1]]


@dataclass(frozen=True)
class ThreeLinkArm(ls.Robot):
    """State: the joints' angles and speeds. Control: their torques in N m."""

    radius: float = 0.15  # m, how large pictures take it to be

    name = "three_link_arm"
    body = "upper"
    joints = JOINTS
    actuators = JOINTS

    @cached_property
    def dynamics(self) -> ls.Dynamics:  # pyright: ignore[reportIncompatibleMethodOverride]
        return ls.Dynamics(
            motion,
            states=dict.fromkeys(JOINTS, "rad") | {f"{name}_speed": "rad/s" for name in JOINTS},
            controls=dict.fromkeys(JOINTS, "N m"),
            parameters={"length": LENGTH, "mass": MASS, "inertia": INERTIA, "rotor": ROTOR, "damping": DAMPING},
            angles=JOINTS,
            control_limits=(-TORQUE, TORQUE),
        )

    @cached_property
    def balls(self) -> ls.CollisionSpheres:  # pyright: ignore[reportIncompatibleVariableOverride]
        between = [None] * (LINK.count - 1)
        sites = [site for number in range(3) for site in (*between, f"end {number}")]
        return ls.CollisionSpheres(places, 3 * LINK.radii, sites=sites)

    def state(self, qpos: Any, qvel: Any, near: Any = None) -> Array:
        state = np.concatenate([qpos, qvel], axis=-1)
        return state if near is None else self.dynamics.state_coordinates.nearest(state, near)

    def configuration(self, state: Any) -> tuple[Array, Array]:
        state = np.asarray(state)
        return state[..., :3], state[..., 3:]


def mjcf() -> str:
    """The arm among the posts."""
    posts = "".join(
        f'<geom name="{name}" type="cylinder" size="{POST} 0.15" pos="{x} {y} 0.15" rgba="0.35 0.4 0.48 1"/>'
        for name, (x, y) in POSTS.items()
    )
    links = ""
    for number, (joint, body) in enumerate(zip(JOINTS, ("upper", "fore", "hand"), strict=True)):
        place = f"0 0 {HEIGHT}" if number == 0 else f"{LENGTH} 0 0"
        links += f"""
    <body name="{body}" pos="{place}">
      <joint name="{joint}" axis="0 0 1" damping="{DAMPING}" armature="{ROTOR}"/>
      <inertial pos="{LENGTH / 2} 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
      <geom name="link {number}" type="capsule" fromto="0 0 0 {LENGTH} 0 0" size="{RADIUS}" rgba="0.9 0.45 0.12 1"/>
      <site name="end {number}" pos="{LENGTH} 0 0" rgba="0 0 0 0"/>"""
    motors = "".join(
        f'<motor name="{joint}" joint="{joint}" ctrllimited="true" ctrlrange="{-TORQUE} {TORQUE}"/>' for joint in JOINTS
    )
    return f"""
<mujoco model="three-link arm">
  <option timestep="0.005" integrator="RK4"/>
  <visual>
    <global offwidth="1280" offheight="720"/>
    <headlight ambient="0.25 0.25 0.25" diffuse="0.35 0.35 0.35"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.94 0.95 0.97" rgb2="0.72 0.77 0.84" width="64" height="384"/>
  </asset>
  <worldbody>
    <light pos="0 0 3" directional="true" diffuse="0.4 0.4 0.4"/>
    <camera name="overview" pos="0.15 -1.9 2.4" xyaxes="1 0 0 0 0.77 0.64"/>
    <geom name="table" type="plane" size="1.6 1.6 0.1" rgba="0.8 0.8 0.78 1" contype="0" conaffinity="0"/>
    <geom name="socket" type="cylinder" size="0.05 0.055" pos="0 0 0.055" rgba="0.3 0.3 0.3 1" contype="0"
      conaffinity="0"/>
    {posts}{links}
    </body></body></body>
  </worldbody>
  <contact>
    <exclude body1="upper" body2="fore"/>
    <exclude body1="fore" body2="hand"/>
    <exclude body1="upper" body2="hand"/>
  </contact>
  <actuator>{motors}</actuator>
</mujoco>
"""


def load(folder: Path) -> ls.Scene:
    """The scene; its MJCF is written to the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "three_link_arm.xml"
    path.write_text(mjcf(), encoding="utf-8")
    return ls.load_scene(path)


def problem(robot: ThreeLinkArm, world: ls.World) -> ls.Problem:
    """From one side of the posts to the other, from rest to rest."""
    rest = (0.0, 0.0, 0.0)
    return ls.Problem(
        dynamics=robot.dynamics,
        dt=0.05,
        steps=160,
        initial=ls.FixedState((*START, *rest)),
        stage_cost=ls.ControlCost(np.full(3, 0.05))
        + ls.ObstacleCost(world, balls=robot.balls, sharpness=20.0, weight=0.002),
        final_cost=ls.QuadraticCost(np.full(6, 1000.0), about=(*GOAL, *rest)),
        # What the balls miss of the links is kept free, too, and what a link may move between two steps.
        constraints=[ls.Clearance(world, balls=robot.balls, margin=LINK.missed + MARGIN)],
    )


def distances(plant: ls.Plant, frames: Array) -> Array:
    """MuJoCo's distance of the nearest link to each post (F, posts), at frames (F, 3), in metres."""
    model, data = plant.model, mujoco.MjData(plant.model)
    links, posts = ([model.geom(name).id for name in names] for names in (map("link {}".format, range(3)), POSTS))
    found = np.empty((len(frames), len(posts)))
    for row, frame in zip(found, frames, strict=True):
        data.qpos[:] = frame
        mujoco.mj_kinematics(model, data)
        for k, post in enumerate(posts):
            row[k] = min(mujoco.mj_geomDistance(model, data, link, post, 3.0, None) for link in links)
    return found


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = Path("runs/three_link_arm")
    """Folder for the files."""
    trials: int = 100
    """Disturbed runs."""
    noise: float = 0.05
    """Of each torque, in N m."""


def main(config: Config) -> dict[str, Any]:
    """Solve, run and measure; the numbers."""
    robot = ThreeLinkArm()
    plant = ls.Plant(robot, load(config.out))
    check = ls.check_plant(robot, plant.scene)
    solution = ls.smooth(problem(robot, plant.world))
    calm = ls.simulate(plant, solution)
    trials = 10 if config.quick else config.trials
    noisy = ls.simulate(plant, solution, disturbances=[ls.disturbances.ControlNoise(config.noise)], trials=trials)
    clear = [distances(plant, frames).min() for frames in (calm.frames[0], *noisy.frames)]
    assert solution.clearance is not None
    found = {
        "plant": str(check),
        "solution": solution.summary(),
        "balls": len(robot.balls),
        "missed": LINK.missed,
        "status": str(solution.status),
        "iterations": len(solution.iterations),
        "ms an iteration": 1e3 * float(np.median([one.seconds for one in solution.iterations])),
        "planned": float(solution.clearance.min()),
        "calm": calm.outcome[0],
        "calm clear": float(clear[0]),
        "noisy reached": int(noisy.reached.sum()),
        "noisy clear": float(min(clear[1:])),
        "trials": trials,
    }
    if not config.quick:
        ls.view.plot_run(
            solution, {"undisturbed": calm, "disturbed": noisy}, config.out / "arm.png", world=plant.scene.world
        )
        ls.render(calm, config.out / "arm.mp4", insets=("top", "side"))
    return opening(config) | found


def report(found: dict[str, Any]) -> str:
    return f"""\
{found["plant"]}
{found["solution"]}
{found["balls"]} balls, of which the links stick out by {1e3 * found["missed"]:.1f} mm at most
plan: {found["status"]} after {found["iterations"]} iterations of {found["ms an iteration"]:.1f} ms; the balls are \
{1e3 * found["planned"]:.0f} mm clear at least
undisturbed: {found["calm"]}; by MuJoCo every link is {1e3 * found["calm clear"]:.0f} mm clear at least
disturbed: {found["noisy reached"]} of {found["trials"]} reached the goal; by MuJoCo the nearest was \
{1e3 * found["noisy clear"]:.0f} mm clear"""


if __name__ == "__main__":
    run(Config, main, report, __doc__)
