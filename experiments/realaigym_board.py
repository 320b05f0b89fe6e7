"""The boards of RealAIGym, rebuilt from their published specification: acrobot and pendubot, versions 1 and 2.

    python experiments/realaigym_board.py                          # all of them, some half an hour on two processors
    python experiments/realaigym_board.py --boards performance     # a minute
    python experiments/realaigym_board.py --robots acrobot         # one of the robots
    python experiments/realaigym_board.py --every 5                # a fifth of the levels of robustness
    python experiments/realaigym_board.py --quick                  # as little as shows how it works

A double pendulum with one motor swings up and balances within 10 s.

robustness     672 runs, or 722 in version 2, each with something wrong that its law is not told. The law plans the
               swing-up with `ls.smooth`, solves again 25 times a second with `ls.prepare`, and plans from anew where
               the plan does not lead up any more. `board/trials.py` says what counts.
performance    One run with nothing wrong, judged by time, energy, torque, smoothness and velocities. The same law,
               with weights for that. `board/performance.py` has the criteria.

Published scores are of other people's runs of the board's own program, which draws other random numbers.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any, Literal

import numpy as np
from board.double_pendulum import Robot
from board.law import ROBUST, Aim, SwingUp
from board.performance import CRITERIA, WEIGHTS, criteria, score
from board.performance import run as perform
from board.trials import MODEL, Trial, columns, of_parameters, simulate, trials
from numpy.typing import NDArray
from runner import FolderSettings, Result, opening, run, table
from tqdm import tqdm

from lqrsim.machine import processors

# The best scores on the board, with what they are of.
PUBLISHED = {
    ("acrobot", 1): (0.861, "tracking LQR"), ("pendubot", 1): (0.950, "tracking LQR"),
    ("acrobot", 2): (0.751, "a learnt policy"), ("pendubot", 2): (0.913, "a learnt policy"),
}  # fmt: skip
PERFORMANCE = {("acrobot", 1): 0.869, ("pendubot", 1): 0.891, ("acrobot", 2): 0.655, ("pendubot", 2): 0.682}
BATCH = 24  # trials that a process runs at once

# Trials that run side by side, with the robot, the version of the board, the seed, and what plans are for.
Job = tuple[list[Trial], Robot, int, int, Aim | None]


@dataclass(frozen=True, kw_only=True)
class Config(FolderSettings):
    robots: tuple[Robot, ...] = ("acrobot", "pendubot")
    """Which of them."""
    versions: tuple[int, ...] = (1, 2)
    """Of the board."""
    boards: tuple[Literal["robustness", "performance"], ...] = ("robustness", "performance")
    """Which of them."""
    every: int = 1
    """Of so many levels one; and of so many pushed runs."""
    effort: float | None = None
    """Weight of the torque in the plans of robustness. By default each board's own."""
    seed: int = 0
    """Of the noise and the pushes."""


def main(config: Config) -> Result:
    result = opening(config)
    result["boards"], result["performance"] = [], []
    for version in config.versions:
        for robot in config.robots:
            if "performance" in config.boards:
                found = criteria(*perform(robot, version), robot, version)
                one = {"robot": robot, "version": version, "criteria": found.tolist(), "score": score(found, version)}
                result["performance"].append(one)
            if "robustness" not in config.boards:
                continue
            chosen = few(trials(robot, version), config.every)
            if config.quick:
                chosen = chosen[:: len(chosen) // 2]
            parts = [chosen[i : i + BATCH] for i in range(0, len(chosen), BATCH)]
            aim = None if config.effort is None else replace(ROBUST, effort=config.effort)
            jobs: list[Job] = [(part, robot, version, config.seed, aim) for part in parts]
            if len(jobs) == 1:
                done = [outcomes(jobs[0])]
            else:
                with ProcessPoolExecutor(processors(), mp_context=get_context("spawn")) as pool:
                    name = f"{robot}, version {version}"
                    done = list(tqdm(pool.map(outcomes, jobs), name, len(jobs), disable=None))
            succeeded = np.concatenate(done)
            board: dict[str, Any] = {"robot": robot, "version": version, "trials": len(chosen)}
            board |= {"columns": columns(chosen, succeeded), "parameters": of_parameters(chosen, succeeded)}
            result["boards"].append(board)
    return result


def few(all_of_them: list[Trial], every: int) -> list[Trial]:
    """One in so many levels of each column, with all its repetitions."""
    levels: dict[str, list[float]] = {}
    for one in all_of_them:
        known = levels.setdefault(one.column, [])
        if one.level not in known:
            known.append(one.level)
    return [one for one in all_of_them if levels[one.column].index(one.level) % every == every // 2]


def outcomes(job: Job) -> NDArray[np.bool_]:
    """Which of some trials succeed."""
    chosen, robot, version, seed, aim = job
    return simulate(chosen, SwingUp(robot, version, len(chosen), aim), robot, version, seed)


def report(result: Result) -> str:
    rows, parts = [], []
    for board in result["boards"]:
        ours, name = board["columns"], f"{board['robot']}, version {board['version']}"
        best, whose = PUBLISHED[board["robot"], board["version"]]
        noise = "velocity noise", "torque noise", "response", "delay", "pushes"
        shares = [_percent(ours.get(column)) for column in ("model", *noise)]
        rows.append([name, *shares, f"{ours['score']:.3f}", f"{best:.3f}", whose])
        parts.append([name, *(_percent(board["parameters"].get(parameter)) for parameter in MODEL)])
    head = (
        "board", "model (%)", "velocity noise (%)", "torque noise (%)", "response (%)", "delay (%)", "pushes (%)",
        "score", "best published", "of",
    )  # fmt: skip
    text = []
    if rows:
        count = ", ".join(str(board["trials"]) for board in result["boards"])
        of_model = table(('column "model", of its levels (%)', *MODEL), parts)
        text += ["## The robustness board of RealAIGym", f"Runs: {count}.", table(head, rows), of_model]
    if result["performance"]:
        rows = []
        for one in result["performance"]:
            counts = zip(one["criteria"], WEIGHTS[one["version"]], strict=True)
            cells = [f"{value:.3g}" if weight else "" for value, weight in counts]
            best = PERFORMANCE[one["robot"], one["version"]]
            rows.append([f"{one['robot']}, version {one['version']}", *cells, f"{one['score']:.3f}", f"{best:.3f}"])
        text += ["## The performance board of RealAIGym", table(("board", *CRITERIA, "score", "best published"), rows)]
    return "\n\n".join(text)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"


if __name__ == "__main__":
    run(Config, main, report, __doc__)
