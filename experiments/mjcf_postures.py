"""Plans of robots from MJCFs, from posture to posture, and their runs in MuJoCo on the file as it is.

    python experiments/mjcf_postures.py                                # the arms of this repository
    python experiments/mjcf_postures.py --models panda.xml iiwa14.xml  # any robots
    python experiments/mjcf_postures.py --quick

A plan starts in the first keyframe of the file that has a name, else at rest, with the joints that actuators drive off
their limits: a finger that rests against a limit chatters there. Each goal is drawn: every joint that an
actuator turns or shifts, within a share of its range about the start. It is then brought nearer to the start until a
smooth ramp to it, in the time of the plan and with controls that are held for a period, needs only forces and controls
within their limits, by MuJoCo's inverse dynamics, and touches nothing that the start does not touch. So a way to it is
known, and the solver does not know it. What counts: the status, whether the undisturbed run of the policy on the
untouched file ends within a twentieth of the range of the goal, and how far this run is from the plan at most.
Processor time includes making the problem; a solve before the first one compiles.
"""

import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from mjcf.files import ARM, REACHER, TWO_LINKS
from runner import Result, Settings, at_most, opening, progress, run, table

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml

OWN = {"arm of six hinges": ARM, "reacher": REACHER, "two links": TWO_LINKS}
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)  # hinges come after it
TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
NEARER, NEARINGS = 0.8, 8  # factor by which a goal is brought nearer, and how often
DRAWS = 100  # of a goal, until a ramp to it is possible
REACHED = 0.05  # of the range of a joint, or of a turn or of 1 m where it has none
LEFT = 0.05  # fraction of its range that a goal keeps from a joint's limits


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    models: tuple[Path, ...] = ()
    """MJCFs of robots; by default some arms in this repository."""
    goals: int = 10
    """For each robot."""
    share: float = 1 / 3
    """Of each joint's range, from the start to the goal at most; of half a turn where it has no range."""
    steps: int = 60
    """Control periods of a plan, of about 20 ms each."""
    time_limit: float = 60.0
    """Seconds for each plan."""
    threads: int = 1
    """Of the solver."""
    seed: int = 0
    """Of the goals."""


def main(config: Config) -> Result:
    """What became of each goal of each robot."""
    config = at_most(config, goals=2, steps=20)
    robots = {path.parent.name + "/" + path.stem: path for path in config.models} or {
        name: scene_from_xml(xml, name) for name, xml in OWN.items()
    }
    return opening(config) | {
        "config": {"goals": config.goals, "share": config.share, "steps": config.steps},
        "robots": {name: list(plans(config, name, ls.MjcfRobot(file))) for name, file in robots.items()},
    }


def plans(config: Config, name: str, robot: ls.MjcfRobot) -> Iterator[dict[str, object]]:
    """One plan after the other, each with what the run of its policy did."""
    model, start = robot.scene.model, beginning(robot)
    dt = robot.dynamics.period_near(0.02) or robot.dynamics.period
    width = np.concatenate([widths(model), np.ones(len(start) - model.nv)])
    plant = ls.Plant(robot, robot.scene)
    goals = [drawn(config, robot, start, dt, seed) for seed in range(config.goals)]
    ls.smooth(robot.problem(start, goals[0], steps=config.steps, dt=dt), max_iterations=1, threads=config.threads)
    for goal in progress(goals, name):
        clock = time.process_time()
        problem = robot.problem(start, goal, steps=config.steps, dt=dt)
        solution = ls.smooth(problem, time_limit=config.time_limit, threads=config.threads)
        seconds = time.process_time() - clock
        with warnings.catch_warnings(action="ignore"):
            rollout = ls.simulate(plant, solution)
        off = np.abs(rollout.states[0][: config.steps + 1] - solution.trajectory.states)[:, : model.nv]
        missed = np.abs(rollout.states[0][config.steps] - goal)[: model.nv] / width[: model.nv]
        yield {
            "status": solution.status.name, "seconds": seconds, "iterations": len(solution.iterations),
            "violation": solution.violation, "missed": float(missed.max()), "off": float(off.max()),
        }  # fmt: skip


def beginning(robot: ls.MjcfRobot) -> Array:
    """The state of the first keyframe that has a name, else the file's rest."""
    model = robot.scene.model
    names = [model.key(i).name for i in range(model.nkey)]
    state = next((robot.at(name) for name in names if name), robot.at())
    state[model.nv : 2 * model.nv] = 0.0
    for joint in [*driven(model), *on_tendons(model)]:
        if model.jnt_limited[joint]:
            (low, high), dof = model.jnt_range[joint], model.jnt_dofadr[joint]
            state[dof] = np.clip(state[dof], low + LEFT * (high - low), high - LEFT * (high - low))
    return robot.with_closed_loops(state)


def widths(model: mujoco.MjModel) -> Array:
    """The range of each degree of freedom; a turn or 1 m, where its joint has none."""
    found = np.full(model.nv, 1.0)
    for joint in range(model.njnt):
        if model.jnt_type[joint] > SLIDE:
            found[model.jnt_dofadr[joint]] = 2 * np.pi
        if model.jnt_limited[joint] and model.jnt_type[joint] >= SLIDE:
            found[model.jnt_dofadr[joint]] = np.ptp(model.jnt_range[joint])
    return found


def drawn(config: Config, robot: ls.MjcfRobot, start: Array, dt: float, seed: int) -> Array:
    """A goal that a smooth ramp reaches within the limits."""
    model, rng = robot.scene.model, np.random.default_rng([config.seed, seed])
    for _ in range(DRAWS):
        away = np.zeros(len(start))
        for joint in driven(model):
            dof, limited = model.jnt_dofadr[joint], model.jnt_limited[joint]
            low, high = model.jnt_range[joint] if limited else (-np.pi / 2, np.pi / 2)
            there = start[dof] + config.share * rng.uniform(-1, 1) * (high - low)
            if limited:
                there = np.clip(there, low + LEFT * (high - low), high - LEFT * (high - low))
            away[dof] = there - start[dof]
        for _ in range(NEARINGS):
            goal = robot.with_closed_loops(start + away)
            if ramp_is_possible(robot, start, goal, config.steps, dt):
                return goal
            away *= NEARER
    raise ls.errors.InputError(f"{robot.name}: got no ramp from the start that is within the limits")


def driving(model: mujoco.MjModel) -> list[int]:
    """The actuators that turn a hinge or shift a slide."""
    joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    found = [i for i in range(model.nu) if model.actuator_trntype[i] in joints]
    return [i for i in found if model.jnt_type[model.actuator_trnid[i, 0]] >= SLIDE]


def driven(model: mujoco.MjModel) -> list[int]:
    """The joints that these act on."""
    return sorted({int(model.actuator_trnid[i, 0]) for i in driving(model)})


def on_tendons(model: mujoco.MjModel) -> list[int]:
    """The joints that fixed tendons of actuators turn or shift, such as those of a gripper's fingers."""
    tendons = [model.actuator_trnid[i, 0] for i in range(model.nu) if model.actuator_trntype[i] == TENDON]
    wraps = [j for i in tendons for j in range(model.tendon_adr[i], model.tendon_adr[i] + model.tendon_num[i])]
    return sorted({int(model.wrap_objid[j]) for j in wraps if model.wrap_type[j] == mujoco.mjtWrap.mjWRAP_JOINT})


def ramp_is_possible(robot: ls.MjcfRobot, start: Array, goal: Array, steps: int, dt: float) -> bool:
    """Whether actuators can drive the joints along a quintic from one posture to another, at rest at both.

    A control is held for a period, and a servo's force changes as it moves: what a period needs in its middle decides
    on its control, and the forces at both of its ends have to be within the limits, too.
    """
    model, data = robot.scene.model, mujoco.MjData(robot.scene.model)
    nv, away = model.nv, (goal - start)[: robot.scene.model.nv]
    bars = [Bar(model, i) for i in driving(model)]

    def move(t: float) -> Array:
        """To a time in periods. Returns the forces that the joints need."""
        s = t / steps
        data.qpos[:] = robot.mjcf.qpos_of(start[:nv] + away * s**3 * (10 - 15 * s + 6 * s**2))
        data.qvel[:] = away * 30 * s**2 * (1 - s) ** 2 / (steps * dt)
        data.qacc[:] = away * 60 * s * (1 - s) * (1 - 2 * s) / (steps * dt) ** 2
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse

    move(0)
    touching = data.ncon
    for t in range(steps):
        needed = move(t + 0.5)
        if data.ncon > touching:
            return False
        controls = [bar.control(data, needed) for bar in bars]
        for end in (t, t + 1):
            move(end)
            if not all(bar.allows(data, control) for bar, control in zip(bars, controls, strict=True)):
                return False
    return True


class Bar:
    """An actuator that turns or shifts a joint, with a force that is linear in the control and in the joint's state."""

    def __init__(self, model: mujoco.MjModel, actuator: int) -> None:
        joint = int(model.actuator_trnid[actuator, 0])
        self.place, self.dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self.gear, self.gain = float(model.actuator_gear[actuator, 0]), float(model.actuator_gainprm[actuator, 0])
        self.bias = model.actuator_biasprm[actuator, :3]
        limited = bool(model.actuator_ctrllimited[actuator])
        self.controls = model.actuator_ctrlrange[actuator] if limited else (-np.inf, np.inf)
        ranges = [(-np.inf, np.inf)]
        if model.actuator_forcelimited[actuator]:
            ranges.append(tuple(model.actuator_forcerange[actuator]))
        if model.jnt_actfrclimited[joint]:
            ranges.append(tuple(np.sort(model.jnt_actfrcrange[joint] / self.gear)))
        self.forces = max(low for low, _ in ranges), min(high for _, high in ranges)

    def rest(self, data: mujoco.MjData) -> float:
        """The force without a control."""
        return self.bias @ (1.0, self.gear * data.qpos[self.place], self.gear * data.qvel[self.dof])

    def control(self, data: mujoco.MjData, needed: Array) -> float:
        """That by which the joint gets the force that it needs."""
        return (needed[self.dof] / self.gear - self.rest(data)) / self.gain

    def allows(self, data: mujoco.MjData, control: float) -> bool:
        """Whether the control and its force now are within their limits."""
        force = self.gain * control + self.rest(data)
        return self.controls[0] <= control <= self.controls[1] and self.forces[0] <= force <= self.forces[1]


def report(result: Result) -> str:
    head = (
        "robot", "converged", "reached", "median s", "longest s", "median iterations", "farthest from the plan",
        "other statuses",
    )  # fmt: skip
    rows = []
    for name, found in result["robots"].items():
        seconds, statuses = [one["seconds"] for one in found], [one["status"] for one in found]
        rows.append([
            name, f"{statuses.count('CONVERGED')} of {len(found)}",
            str(sum(one["missed"] <= REACHED for one in found)), f"{np.median(seconds):.1f}", f"{max(seconds):.1f}",
            f"{np.median([one['iterations'] for one in found]):.0f}", f"{max(one['off'] for one in found):.0e}",
            ", ".join(sorted(set(statuses) - {"CONVERGED"})) or "none",
        ])  # fmt: skip
    return table(head, rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
