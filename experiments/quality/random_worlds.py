"""Random worlds of both robots, one in five nearly blocked, with and without a clearance to be kept; beside the peers.

FDDP knows no limits of the controls; all others keep those of the actuators. Nothing is timed.
"""

from typing import Any, get_args

import numpy as np
from reliability.common import mean
from runner import judge, progress

import lqrsim as ls
from quality import worlds
from quality.common import Config, Found, clear, clearance, converged, cost, endings, of_solutions, others, skips, solve

TOLERANCE = 1e-3  # m, at the steps, where a clearance is kept
LOWER = 1e-4  # relative, what is a lower mean cost; by so much plans that have settled differ
FDDP, IPOPT = ("FDDP, hover", "FDDP, line"), ("IPOPT, line",)


def measure(config: Config) -> dict[str, Any]:
    found: dict[str, Any] = {"robots": {}, "skipped": {}}
    for robot in get_args(worlds.Kind):
        drawn = [worlds.draw(robot, index, config.world_seed) for index in range(config.worlds)]
        free = [one.problem for one in drawn]
        slow = config.ipopt_clear_worlds if robot == "quadrotor" else config.ipopt_worlds
        one: dict[str, Any] = {"blocked": [world.gap is not None for world in drawn]}
        for how, problems, peers in (
            ("free", free, {FDDP: config.worlds, IPOPT: config.ipopt_worlds}),
            ("kept", [clear(problem) for problem in free], {IPOPT: slow}),
        ):
            name = f"worlds, {robot}, {how}"
            one[how] = {"smooth": ours(config, problems, name)}
            for names, count in peers.items():
                theirs, skipped = ask(config, problems[:count], names, f"{name}, {names[0]}")
                one[how] |= theirs
                found["skipped"] |= skipped
        found["robots"][robot] = one
    return found


def ours(config: Config, problems: list[ls.Problem], name: str) -> Found:
    """Default settings, untouched."""
    solutions = solve(config, problems, name)
    plans = list(zip(problems, solutions, strict=True))
    return of_solutions(problems, solutions, name) | {
        "clearance": [
            clearance(problem, solution.trajectory.controls)
            for problem, solution in progress(plans, f"{name}, clearance")
        ]
    }


def ask(
    config: Config, problems: list[ls.Problem], names: tuple[str, ...], name: str
) -> tuple[dict[str, Found], dict[str, str]]:
    """What others make of the worlds; a solver is made for each."""
    found: dict[str, Found] = {}
    skipped: dict[str, str] = {}
    for problem in progress(problems, name):
        solvers, skipped = others(config, problem, names, compile=False)
        for who, solver in solvers.items():
            one = found.setdefault(who, {"status": [], "cost": [], "clearance": [], "iterations": []})
            answer = solver(problem)
            one["status"].append("CONVERGED" if answer.converged else "failed")
            one["cost"].append(cost(problem, answer.controls))
            one["clearance"].append(clearance(problem, answer.controls))
            one["iterations"].append(answer.iterations)
    return found, skipped


def report(found: dict[str, Any]) -> list[str]:
    rows = [
        f"worlds: {'':<26} {'converged':>10} {'clear':>9} {'blocked ones':>13} {'mean cost':>10} {'median':>8}"
        f" {'iterations':>11} {'theirs and ours where both count':>33}"
    ]
    asked: list[str] = []
    lower: list[str] = []
    for robot, one in found["robots"].items():
        for how in ("free", "kept"):
            for who, theirs in one[how].items():
                both = shared(theirs, one[how]["smooth"], how)
                rows.append(row(robot, how, who, theirs, both, one["blocked"]))
                if who != "smooth" and how == "free":
                    asked.append(who)
                    lower += [f"{who} of {robot}"] if both[0] < (1 - LOWER) * both[1] else []
    if asked:
        names = ", ".join(lower) or "none"
        rows.append(f"  peers with a lower mean cost, without a clearance: {names}  {judge(not lower, 'none')}")
    rows.append(
        "  clear: at the steps; where a clearance is to be kept, to 1 mm and converged. Costs count of those that"
    )
    rows.append("  converged, and then keep it. IPOPT solves the first worlds only where there are fewer")
    for robot, one in found["robots"].items():
        for how in ("free", "kept"):
            mine = one[how]["smooth"]
            rows += [
                f"  {robot}, {how}, world {i}{' (blocked)' * one['blocked'][i]}: {status}: {mine['detail'][i]}"
                for i, status in enumerate(mine["status"])
                if status != "CONVERGED"
            ]
    return ["\n".join(rows + skips(found["skipped"]))]


def row(robot: str, how: str, who: str, one: Found, both: tuple[float, float, int], blocked: list[bool]) -> str:
    clear_ones, count = solved(one, how), len(one["cost"])
    costs = [cost for cost, good in zip(one["cost"], counted(one, how), strict=True) if good]
    shut = [good for good, gap in zip(clear_ones, blocked, strict=False) if gap]
    damped = f"{sum(one['damped'])} damped" if "damped" in one else ""
    compared = f"{both[0]:>14.2f} {both[1]:>9.2f} in {both[2]:<5}" if who != "smooth" else " " * 33
    return (
        f"  {robot + (', clearance' if how == 'kept' else ''):<20} {who:<11} {converged(one):>6}/{count:<3}"
        f" {sum(clear_ones):>5}/{count:<3} {sum(shut):>9}/{len(shut):<3} {mean(costs):>10.2f}"
        f" {np.median(costs) if costs else np.nan:>8.2f} {np.mean(one['iterations']):>11.1f}"
        f" {compared}  {', '.join(filter(None, (damped, endings(one))))}"
    ).rstrip()


def solved(one: Found, how: str) -> list[bool]:
    """Which plans are clear; where a clearance is to be kept, they have to have converged as well."""
    pairs = zip(one["clearance"], one["status"], strict=True)
    if how == "free":
        return [least >= 0 for least, _ in pairs]
    return [least >= -TOLERANCE and status == "CONVERGED" for least, status in pairs]


def counted(one: Found, how: str) -> list[bool]:
    """Which costs count: not those of plans that are unfinished, or that do not keep the clearance they are to keep."""
    return solved(one, how) if how == "kept" else [status == "CONVERGED" for status in one["status"]]


def shared(theirs: Found, mine: Found, how: str) -> tuple[float, float, int]:
    """Mean costs, theirs and ours, of those where both count, and how many that are."""
    good = zip(counted(theirs, how), counted(mine, how), strict=False)
    pairs = [
        pair for pair, (a, b) in zip(zip(theirs["cost"], mine["cost"], strict=False), good, strict=False) if a and b
    ]
    return mean(their for their, _ in pairs), mean(our for _, our in pairs), len(pairs)
