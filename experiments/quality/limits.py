"""Limits of the controls: kept exactly, and what IPOPT makes of the same ones."""

from dataclasses import replace
from typing import Any

import numpy as np
import peers
from reliability.common import fixed
from runner import judge, progress

import lqrsim as ls
from quality import worlds
from quality.common import Config, Found, converged, cost, endings, ipopt, of_solutions, queries, skips, solve

ROTORS, WHEELS = (1.05, 1.40), (-0.27, 0.27)  # N, and m/s
NEAR = 0.01
LEAST = 20  # queries with limits in force that are to be about as good


def measure(config: Config) -> dict[str, Any]:
    drives = [worlds.draw("drive", index, config.world_seed).problem for index in range(config.limited_worlds)]
    drives = [fixed(ls.scenarios.differential_drive().problem), *drives]
    problems = {
        "quadrotor": queries(config.queries, config.seeds[0], ROTORS),
        "drive": [replace(problem, control_limits=WHEELS) for problem in drives],
    }
    found: dict[str, Any] = {"robots": {}, "skipped": {}}
    for robot, mine in problems.items():
        name = f"limits, {robot}"
        solutions = solve(config, mine, name, starts=1)
        one = of_solutions(mine, solutions, name)
        pairs = list(zip(mine, solutions, strict=True))
        one["at_limits"] = [at_limits(*pair) for pair in pairs]
        one["within"] = [within(*pair) for pair in pairs]
        one["followed"] = [followed(solution) for solution in solutions]
        try:
            if not config.peers:
                raise peers.Unavailable("not asked for")
            one |= compare(pairs, f"{name}, IPOPT", same=robot == "quadrotor")
        except peers.Unavailable as error:
            found["skipped"]["IPOPT"] = str(error)
        found["robots"][robot] = one
    return found


def commanded(solution: ls.Solution) -> np.ndarray:
    """What the policy says along its plan, (T, m)."""
    plan = solution.trajectory
    return np.array([solution.policy(state, t) for state, t in zip(plan.states, plan.times[:-1], strict=False)])


def within(problem: ls.Problem, solution: ls.Solution) -> bool:
    """Whether the plan and what the policy says along it are within the limits, to the last bit."""
    space = problem.control_coordinates
    both = np.concatenate([solution.trajectory.controls, commanded(solution)])
    return bool(((both >= space.low) & (both <= space.high)).all())


def at_limits(problem: ls.Problem, solution: ls.Solution) -> float:
    """What share of all controls is at a limit."""
    space, controls = problem.control_coordinates, solution.trajectory.controls
    return float(((controls == space.low) | (controls == space.high)).mean())


def followed(solution: ls.Solution) -> float:
    """How far the policy is from the plan's own controls, at most."""
    return float(np.abs(commanded(solution) - solution.trajectory.controls).max())


def compare(pairs: list[tuple[ls.Problem, ls.Solution]], name: str, *, same: bool) -> Found:
    """IPOPT's costs from the line, and from each plan; compiled if all are in the `same` world."""
    found: Found = {"from_line": [], "from_plan": []}
    shared = ipopt(pairs[0][0], compile=True) if same else None
    for problem, solution in progress(pairs, name):
        solver, plan = shared or ipopt(problem, compile=False), solution.trajectory
        answers = solver.from_line(problem), solver.solve(problem, plan.states, plan.controls)
        for some, answer in zip(found.values(), answers, strict=True):
            some.append({"cost": cost(problem, answer.controls), "converged": answer.converged})
    return found


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"limits: {'':<10} {'converged':>10} {'iterations':>11} {'damped':>7} {'within them':>12} {'at them':>8}"
        f" {'(of controls)':>14} {'mean cost':>10} {'policy off plan':>16}"
    ]
    near = active = outside = 0
    for robot, one in found["robots"].items():
        count, held = len(one["cost"]), [share > 0 for share in one["at_limits"]]
        active, outside = active + sum(held), outside + count - sum(one["within"])
        share = 100 * np.mean(one["at_limits"])
        rows.append(
            f"  {robot:<16} {converged(one):>6}/{count:<3} {np.mean(one['iterations']):>11.2f}"
            f" {sum(one['damped']):>7} {sum(one['within']):>12} {sum(held):>8} {share:>12.1f} %"
            f" {np.mean(one['cost']):>10.3f} {max(one['followed']):>16.1e}  {endings(one)}".rstrip()
        )
    for robot, one in found["robots"].items():
        if "from_line" not in one:
            continue
        for start in ("line", "plan"):
            theirs = one[f"from_{start}"]
            done = [i for i, answer in enumerate(theirs) if answer["converged"]]
            excess = np.array([one["cost"][i] / theirs[i]["cost"] - 1 for i in done])
            lower, higher = int((excess < -NEAR).sum()), int((excess > NEAR).sum())
            rows.append(
                f"  {robot}: of {len(done)} of {len(theirs)} that IPOPT solves from the {start}, we are lower in"
                f" {lower}, equal within 1 % in {len(done) - lower - higher}, higher in {higher};"
                f" mean cost {np.mean([one['cost'][i] for i in done]):.3f}, IPOPT's"
                f" {np.mean([theirs[i]['cost'] for i in done]):.3f}; at worst {100 * excess.max(initial=0):+.2f} %"
            )
            if start == "plan":
                near += sum(one["at_limits"][i] > 0 and value <= NEAR for i, value in zip(done, excess, strict=True))
    rows.append(f"  outside the limits: {outside}  {judge(outside == 0, 'none, without any tolerance')}")
    if not found["skipped"]:
        rows.append(
            f"  within 1 % of IPOPT from our plan or lower: {near} of the {active} with controls at their limits"
            f"  {judge(near >= LEAST, f'>= {LEAST}')}"
        )
    return ["\n".join(rows + skips(found["skipped"]))]
