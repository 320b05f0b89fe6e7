"""A race through 19 waypoints in least time, beside the best published lap, and how often the lap fails when disturbed.

    python experiments/race.py                                  # some minutes, and a figure in runs/race/figures
    python experiments/race.py --video docs/figures/race.gif    # also a disturbed lap
    python experiments/race.py --quick                          # fewer steps and trials

The course, the quadrotor and the published lap are those of FSC-Lab/TOGT-Planner: `race_uzh_19wp.yaml`,
`cpc_quad.yaml`, and `aos_refined_traj.csv`, of 17.597 s. From rest to rest the quadrotor comes within 0.3 m of each
waypoint, with at most 6.879 N a rotor, and body rates up to 15, 15 and 3 rad/s. There is no floor, and no drag. The
published plan passes waypoints at up to 0.31 m, by its knots, and ends within 0.05 of the goal's states; plans here
keep both exactly. The search begins from straight lines from waypoint to waypoint.

Two more laps leave something to feedback: nine and eight tenths of the force, 12 and 10 rad/s, a radius of 0.15 m, and
a larger effort. They begin from the first. All are integrated by SciPy with the controls held, and flown in MuJoCo by
three laws under the presets `light` and `moderate`, with all of the force: the policy of `smooth`, `ls.track`, and
`ls.OffsetFree`, which knows the uncertainty. A lap fails if it misses a waypoint, by its path between the knots, or
diverges.
"""

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from paper.common import figure, picture
from runner import FolderSettings, Result, at_most, between, interval, opening, progress, run, table
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import lqrsim as ls
from lqrsim.errors import Array
from lqrsim.scenes.scene import scene_from_xml
from lqrsim.stress.statistics import rate

MODELS = Path(__file__).parents[1] / "models"
PUBLISHED = 17.597  # s
PLACES = np.array(
    [(-1.1, -1.6, 3.6), (9.2, 6.6, 1.0), (9.2, -4.0, 1.2), (-4.5, -6.0, 3.5), (-4.5, -6.0, 0.8), (4.75, -0.9, 1.2),
     (-2.8, 6.8, 1.2)]
)  # fmt: skip
WAYPOINTS = np.tile(PLACES, (3, 1))[:19]
START, GOAL = np.array([-5.0, 4.5, 1.2]), np.array([4.75, -0.9, 1.2])
RADIUS = 0.3  # m
# Their rotors are at 45 degrees to their body axes, ours on the axes: headings and body rates are turned by that much.
ROBOT = ls.Quadrotor(
    mass=0.85, inertia=0.001, yaw_inertia=0.0017, arm=0.15, torque_ratio=0.05, drag=0.0, gravity=9.8066,
    max_force=6.879, radius=0.15,
)  # fmt: skip
HEADING, YAW_RATE = -np.pi / 4, 3.0
SUBSTEPS = 1600  # Runge-Kutta steps of a lap, at least; with fewer, SciPy's path is elsewhere by millimetres
LONGEST = 60.0  # s, of a solve
SPIN = 1.0  # weight of (rad/s)^2 relative to that of N^2; keeps turns that gain nothing away
EXACT, END = 1e-3, 1e-2  # m or rad/s by which SciPy's path and the plan may differ on the way, and m or m/s at the end
WIDER = 0.6  # m, twice the radius
# Of both tracking laws: of eight choices, that with which most of 20 laps under `light` passed, by either plan and law.
TOLERATE, EFFORT = {"m": 0.3, "m/s": 1.5, "rad": 0.3, "rad/s": 5.0}, {"N": 1.0}
LAWS, PRESETS = ("smooth", "track", "OffsetFree"), ("light", "moderate")


@dataclass(frozen=True, kw_only=True)
class Lap:
    """What a lap may take.

    Attributes:
      share: of the rotors' force. radius: m. rate: rad/s, about the body's x and y. effort: sum of the weights of N^2
        over the steps. late: duration of the start, relative to the first lap.
    """

    name: str
    share: float
    radius: float
    rate: float
    effort: float
    late: float = 1.0


LIMIT = Lap(name="at the limits", share=1.0, radius=RADIUS, rate=15.0, effort=0.0072)
MARGINS = (
    Lap(name="nine tenths", share=0.9, radius=RADIUS / 2, rate=12.0, effort=0.08, late=1.1),
    Lap(name="eight tenths", share=0.8, radius=RADIUS / 2, rate=10.0, effort=0.2, late=1.15),
)


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    out: Path = Path("runs/race")
    """Folder for the figure, in a folder of that name."""
    steps: int = 1200
    """Control periods of the lap at the limits."""
    fewer: int = 800
    """Of the others, and of that from which they begin."""
    trials: int = 200
    """Laps of each plan, law and preset."""
    video: Path | None = None
    """Writes a video of a disturbed lap, mp4 or gif."""


def near(x: Any, u: Any, p: Any) -> Any:
    return p.radius**2 - (x.x - p.x) ** 2 - (x.y - p.y) ** 2 - (x.z - p.z) ** 2


def rates(x: Any, u: Any, p: Any) -> list[Any]:
    along, across = (x.wx + x.wy) / 2**0.5, (x.wx - x.wy) / 2**0.5
    return [p.rate - along, p.rate + along, p.rate - across, p.rate + across]


def problem_of(lap: Lap, steps: int, *, seconds: float, knots: list[int]) -> ls.Problem:
    """The lap in least time, stated for so many seconds, with the waypoints at these knots."""
    names, state = ROBOT.dynamics.state_coordinates.names, np.zeros(12)
    state[8] = HEADING
    start, goal = (np.concatenate([place, state[3:]]) for place in (START, GOAL))
    weight = lap.effort / steps
    x, y, z = WAYPOINTS.T
    return ls.Problem(
        dynamics=ROBOT.dynamics.with_substeps(max(2, SUBSTEPS // steps)), dt=seconds / steps, steps=steps,
        initial=ls.FixedState(start),
        stage_cost=ls.ControlCost(np.full(4, weight), about=np.full(4, ROBOT.hover_force))
        + ls.QuadraticCost({"rad/s": SPIN * weight}, about={"x": 0.0}),
        final_cost=ls.QuadraticCost(np.zeros(12), about=goal), control_limits=(0.0, lap.share * ROBOT.max_force),
        constraints=[
            ls.GoalState({name: float(at) for name, at in zip(names, goal, strict=True) if name != "rz"}),
            ls.SymbolicConstraint(near, parameters={"x": x, "y": y, "z": z, "radius": lap.radius}, at=knots),
            ls.SymbolicConstraint(rates, parameters={"rate": lap.rate}),
            ls.StateBounds(wz=(-YAW_RATE, YAW_RATE)),
        ],
        duration=(5.0, 60.0), time_weight=1.0, segments=knots,
    )  # fmt: skip


def first_lap(steps: int) -> tuple[ls.Problem, ls.Trajectory]:
    """The lap at the limits, and straight lines to begin from; times of legs go with the root of their lengths."""
    path = np.vstack([START, WAYPOINTS, GOAL])
    passed = np.cumsum(np.sqrt(np.linalg.norm(np.diff(path, axis=0), axis=1)))
    knots = np.rint(passed / passed[-1] * steps).astype(int)[:-1].tolist()
    problem = problem_of(LIMIT, steps, seconds=20.0, knots=knots)
    states, at = np.tile(np.asarray(problem.start), (steps + 1, 1)), np.arange(steps + 1)
    states[:, :3] = np.column_stack([np.interp(at, [0, *knots, steps], axis) for axis in path.T])
    states[1:-1, 3:6] = (states[2:, :3] - states[:-2, :3]) / (2 * problem.dt)
    return problem, ls.Trajectory(states, np.full((steps, 4), ROBOT.hover_force), problem.dt)


def slower_lap(lap: Lap, problem: ls.Problem, first: ls.Solution) -> tuple[ls.Problem, ls.Trajectory]:
    """A lap with a margin, and the first lap, flown more slowly."""
    plan, knots = first.trajectory, list(problem.with_duration_of(first).segments)
    problem = problem_of(lap, plan.steps, seconds=lap.late * plan.horizon, knots=knots)
    states = plan.states.copy()
    states[:, 3:6] /= lap.late
    states[:, 9:12] /= lap.late
    return problem, ls.Trajectory(states, plan.controls, problem.dt)


def integrated(plan: ls.Trajectory) -> Array:
    """The states (T+1, 13) with the plan's controls held, by SciPy, with a quaternion: nothing of it is lqrsim's."""
    inertia, lever = np.array([0.001, 0.001, 0.0017]), 0.15

    def flow(_: float, x: Array, u: Array) -> Array:
        q, w = x[6:10], x[10:13]
        thrust = Rotation.from_quat(q).apply([0.0, 0.0, u.sum() / 0.85]) - [0.0, 0.0, 9.8066]
        torque = [lever * (u[1] - u[3]), lever * (u[2] - u[0]), 0.05 * (u[0] - u[1] + u[2] - u[3])]
        turned = np.array([
            q[3] * w[0] + q[1] * w[2] - q[2] * w[1], q[3] * w[1] + q[2] * w[0] - q[0] * w[2],
            q[3] * w[2] + q[0] * w[1] - q[1] * w[0], -q[:3] @ w,
        ])  # fmt: skip
        return np.concatenate([x[3:6], thrust, turned / 2, (torque - np.cross(w, inertia * w)) / inertia])

    state = plan.states[0]
    states = [np.concatenate([state[:6], Rotation.from_rotvec(state[6:9]).as_quat(), state[9:12]])]
    for control in plan.controls:
        states.append(solve_ivp(flow, (0.0, plan.dt), states[-1], args=(control,), rtol=1e-9, atol=1e-10).y[:, -1])
    return np.array(states)


def misses(paths: Array, knots: list[int]) -> Array:
    """The distance at which each of the paths (K, T+1, 3) passes each waypoint, (K, 19): least about the time planned.

    About it means nearer in time than to the waypoints before and after; between the knots paths are straight.
    """
    ends, found = np.array([0, *knots, paths.shape[1] - 1]), []
    for k, place in enumerate(WAYPOINTS):
        first, last = (ends[k] + ends[k + 1]) // 2, (ends[k + 1] + ends[k + 2]) // 2
        a, b = paths[:, first:last], paths[:, first + 1 : last + 1]
        along = b - a
        share = np.clip(((place - a) * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-12), 0, 1)
        found.append(np.linalg.norm(a + share[..., None] * along - place, axis=-1).min(axis=1))
    return np.array(found).T


def check(lap: Lap, problem: ls.Problem, solution: ls.Solution) -> dict[str, Any]:
    """What SciPy says of a plan, beside what the lap may take."""
    plan, knots = solution.trajectory, list(problem.with_duration_of(solution).segments)
    states, force = integrated(plan), plan.controls
    rate_x, rate_y = states[:, 10:12].T
    body = np.abs([(rate_x + rate_y) / 2**0.5, (rate_x - rate_y) / 2**0.5, states[:, 12]]).max(axis=1)
    passed = np.linalg.norm(states[knots, :3] - WAYPOINTS, axis=1)
    end = float(np.abs(np.concatenate([states[-1, :3] - GOAL, states[-1, 3:6]])).max())
    holds = bool(
        passed.max() <= lap.radius + EXACT and force.min() >= 0 and force.max() <= lap.share * ROBOT.max_force
        and body[:2].max() <= lap.rate + EXACT and body[2] <= YAW_RATE + EXACT and end <= END
    )  # fmt: skip
    return {
        "waypoint": float(passed.max()), "force": [float(force.min()), float(force.max())], "rates": body.tolist(),
        "end": end, "lowest": float(states[:, 2].min()), "holds": holds, "times": [knot * plan.dt for knot in knots],
    }  # fmt: skip


def plant_of(period: float) -> ls.Plant:
    """The packaged quadrotor with these numbers, among the waypoints, which are only drawn."""
    spec = mujoco.MjSpec.from_file(str(MODELS / "quadrotor.xml"))
    spec.option.gravity = [0.0, 0.0, -ROBOT.gravity]
    body = spec.body("quadrotor")
    body.mass, body.inertia = ROBOT.mass, [ROBOT.inertia, ROBOT.inertia, ROBOT.yaw_inertia]
    for joint in body.joints:
        joint.damping[:] = 0.0
    for k in range(4):
        site, rotor = spec.site(f"quadrotor_rotor_{k + 1}"), spec.actuator(f"quadrotor_rotor_{k + 1}")
        site.pos = ROBOT.arm * np.sign(site.pos)
        rotor.gear[5] = ROBOT.torque_ratio * (-1) ** k
        rotor.ctrlrange = [0.0, ROBOT.max_force]
    unseen = {"contype": 0, "conaffinity": 0}
    for name, place in enumerate(PLACES, start=1):
        spec.worldbody.add_geom(
            name=f"waypoint_{name}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], pos=place,
            rgba=[0.1, 0.4, 0.8, 0.35], **unseen,
        )  # fmt: skip
    return ls.Plant(ROBOT, scene_from_xml(spec.to_xml(), "race")).for_period(period)


def flown(config: Config, problem: ls.Problem, solution: ls.Solution) -> tuple[list[dict[str, Any]], ls.Rollout]:
    """How often laps fail, by law and preset; and the runs of `OffsetFree` under the weakest preset."""
    plan, knots = solution.trajectory, list(problem.with_duration_of(solution).segments)
    ordinary = problem.with_duration_of(solution)
    policy = dataclasses.replace(solution.policy, control_coordinates=ROBOT.dynamics.control_coordinates)
    solution = dataclasses.replace(solution, policy=policy)  # feedback has all of the force
    plant, rows, shown = plant_of(plan.dt), list[dict[str, Any]](), list[ls.Rollout]()
    for preset in PRESETS:
        met = ls.disturbances.preset(preset, plant)
        for name in LAWS:
            law: Any = None
            if name == "track":
                law = ls.track(ordinary, solution, tolerate=TOLERATE, effort=EFFORT)
            elif name == "OffsetFree":
                law = ls.OffsetFree(ordinary, solution, ls.uncertainty_of(plant, met), tolerate=TOLERATE, effort=EFFORT)
            runs = ls.simulate(plant, solution, controller=law, disturbances=met, trials=config.trials, seed=0,
                               frames=name == LAWS[-1] and not shown)  # fmt: skip
            if name == LAWS[-1] and not shown:
                shown.append(runs)
            worst = misses(runs.states[:, :, :3], knots).max(axis=1)
            diverged = ~np.isfinite(runs.states).all(axis=(1, 2))
            middle = np.median(np.where(diverged, np.inf, worst))
            fails = [int((diverged | ~(worst <= within + EXACT)).sum()) for within in (RADIUS, WIDER)]
            rows.append({
                "preset": preset, "law": name, "diverged": int(diverged.sum()),
                "fails": [interval(rate(count, config.trials)) for count in fails],
                "miss": float(middle) if np.isfinite(middle) else None,
            })  # fmt: skip
    return rows, shown[0]


def main(config: Config) -> Result:
    config = at_most(config, steps=400, fewer=400, trials=3)
    result = opening(config) | {"laps": []}
    plans = list[tuple[Lap, ls.Problem, ls.Solution]]()
    problem, start = first_lap(config.fewer)
    first = problem, ls.smooth(problem, start=start, threads=1)
    for lap in progress((LIMIT, *MARGINS), "laps", delay=0):
        problem, start = first_lap(config.steps) if lap is LIMIT else slower_lap(lap, *first)
        began = time.process_time()
        solution = ls.smooth(problem, start=start, threads=1, time_limit=LONGEST)
        row = {
            "name": lap.name, "status": solution.status.name, "time": solution.trajectory.horizon,
            "iterations": len(solution.iterations), "seconds": time.process_time() - began,
        }  # fmt: skip
        result["laps"].append(row)
        if not solution.success:
            continue
        plans.append((lap, problem, solution))
        runs, shown = flown(config, problem, solution)
        row |= {"check": check(lap, problem, solution), "runs": runs}
        if config.video is not None and lap is MARGINS[-1]:
            ls.render(shown, config.video, overlays=("plan", "trace", "caption"), size=(560, 316), fps=10, speed=2.0)
    if plans:
        draw(config, result, plans)
    return result


def draw(config: Config, result: Result, plans: list[tuple[Lap, ls.Problem, ls.Solution]]) -> None:
    """The laps from above, and their rotor forces."""
    with figure(config, result, "race", (10, 4)) as drawn:
        above, force = drawn.subplots(1, 2)
        above.plot(*PLACES[:, :2].T, "o", color="0.7", markersize=10)
        for color, (lap, _, solution) in zip(("C3", "C0", "C2"), plans, strict=False):
            plan = solution.trajectory
            above.plot(*plan.states[:, :2].T, color=color, linewidth=1, label=f"{lap.name}, {plan.horizon:.2f} s")
            share = plan.controls.mean(axis=1) / ROBOT.max_force
            force.step(plan.times[:-1], 100 * share, where="post", color=color, linewidth=0.8)
        above.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        above.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, -0.15))
        force.set(xlabel="time (s)", ylabel="mean rotor force (% of the largest)")
        drawn.set_layout_engine("tight")


def report(result: Result) -> str:
    laps = result["laps"]
    head = ("lap", "status", "time (s)", "iterations", "processor (s)", "waypoints within (m)", "force (N)",
            "body rates (rad/s)", "lowest (m)", "check")  # fmt: skip
    rows = []
    for one in laps:
        found = one.get("check")
        plan = [one["name"], one["status"], f"{one['time']:.3f}", one["iterations"], f"{one['seconds']:.1f}"]
        rows.append([*plan, *(["-"] * 5 if found is None else [
            f"{found['waypoint']:.4f}", f"{found['force'][0]:.3f} to {found['force'][1]:.3f}",
            ", ".join(f"{one:.2f}" for one in found["rates"]), f"{found['lowest']:.2f}",
            "holds" if found["holds"] else "DOES NOT HOLD",
        ])])  # fmt: skip
    parts = [
        "## A race through 19 waypoints",
        f"The published lap takes {PUBLISHED} s. What SciPy finds with the controls held:",
        table(head, rows),
    ]
    checked = [one for one in laps if "check" in one]
    if checked:
        passed = zip(*(one["check"]["times"] for one in checked), strict=True)
        parts += [
            "When the waypoints are passed:",
            table(("waypoint", *(f"{one['name']} (s)" for one in checked)),
                  [[k, *(f"{at:.2f}" for at in times)] for k, times in enumerate(passed, start=1)]),
            f"How often laps fail in MuJoCo, in %, of {result['config']['trials']} trials each: a waypoint is missed by"
            f" more than {RADIUS:g} m, or by more than {WIDER:g} m, or the lap diverges. A plan at the limits of the"
            " rotors leaves nothing to feedback.",
            table(
                ("lap", "preset", "law", f"fails, {RADIUS:g} m", f"fails, {WIDER:g} m", "diverged",
                 "worst waypoint, median (m)"),
                [
                    [one["name"], runs["preset"], runs["law"],
                     *(between([100 * part for part in fails], ".1f") for fails in runs["fails"]), runs["diverged"],
                     "-" if runs["miss"] is None else f"{runs['miss']:.3g}"]
                    for one in checked for runs in one["runs"]
                ],
            ),
            picture(result, "race", "The laps from above, and their rotor forces"),
        ]  # fmt: skip
    return "\n\n".join(parts)


def failures(result: Result) -> list[str]:
    """The laps that are CONVERGED, and do not pass the check."""
    return [one["name"] for one in result["laps"] if "check" in one and not one["check"]["holds"]]


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=failures)
