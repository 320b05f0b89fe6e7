"""How fast closed-loop trials are, against MuJoCo's own steps with the same inputs.

    python experiments/benchmark_simulation.py            # both robots, 256 and 1,024 simulations; 10,000 trials
    python experiments/benchmark_simulation.py --quick    # 64 simulations, 500 trials, 2 rounds
    python experiments/benchmark_simulation.py --laws-only

Closed loop: the policy, the demo's noise, what is recorded and the table of outcomes, without contacts of obstacles, as
a stress test runs them. Raw: `mujoco.batch` steps the same model through the same states, with the controls and forces
of a closed loop before, all given ahead, in as many calls as there are control periods. In turns, in one process;
medians. The same with a Kalman filter in the loop, `OffsetFree`; and the processor time in which that and `track` are
made, with tolerances that are given and with those that are chosen.
"""

import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

from mujoco import batch
from runner import Settings, judge, opening, run
from solver_benchmark.common import median, take_turns

import lqrsim as ls
from lqrsim.machine import processors
from lqrsim.stress.analysis import outcomes

LEAST = 0.85  # of raw, one thread
LEAST_WITH_FILTER = 0.8  # with `OffsetFree`
# ms to make, with 12 states and 150 steps.
SOON = {
    "track, quadrotor, tolerances given": 5.0,
    "OffsetFree, quadrotor, light, tolerances given": 20.0,
    "track, quadrotor, light, tolerances chosen": 60.0,
    "OffsetFree, quadrotor, light, tolerances chosen": 60.0,
}
TOLERATED = {"m": 0.05, "m/s": 0.3, "rad": 0.2, "rad/s": 1.0}
TWICE = 1.7  # two threads against one
MOST = 1.3  # 10,000 trials against raw, two threads
MEMORY = 2.0  # GB
FULL = 256  # simulations from which the first target is for


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    simulations: tuple[int, ...] = (256, 1024)
    """At once."""
    trials: int = 10_000
    """Of the quadrotor, in batches of the first number of simulations."""
    rounds: int = 5
    """How often each is timed."""
    laws_only: bool = False
    """Only how long laws take to be made."""
    seed: int = 0
    """Of the noise."""


class Contest:
    """One robot with its policy, ready to be run either way."""

    def __init__(self, name: str, seed: int) -> None:
        self.scenario = ls.scenarios.get(name)
        self.plant = self.scenario.plant()
        self.solution = ls.smooth(self.scenario.problem)
        self.seed = seed
        self.stated = ls.uncertainty_of(self.plant, self.scenario.disturbances)
        self.law = ls.OffsetFree(self.scenario.problem, self.solution, self.stated)

    def closed_loop(
        self, count: int, threads: int, first: int = 0, controller: ls.Controller | None = None
    ) -> ls.Rollout:
        """A batch of trials, as a stress test runs it."""
        rollout = ls.simulate(
            self.plant,
            self.solution,
            controller=controller,
            disturbances=self.scenario.disturbances,
            seed=self.seed,
            trials=count,
            first_trial=first,
            frames=False,
            contacts=False,
            threads=threads,
        )
        outcomes(rollout, self.scenario.problem)
        return rollout

    def raw(self, rollout: ls.Rollout, threads: int) -> Callable[[], None]:
        """MuJoCo's steps with the inputs of a rollout."""
        plant, plan = self.plant, rollout.plan
        simulations = batch.Batch(plant.without_contacts, rollout.trials, threads)
        qpos, qvel = plant.robot.configuration(plan.states[0])
        controls = plant.robot.actuation(rollout.applied).transpose(1, 0, 2).copy()
        forces = rollout.forces.transpose(1, 0, 2).copy()
        substeps = plant.substeps(plan.dt)

        def run() -> None:
            simulations.reset()
            simulations.qpos[:, plant.qpos], simulations.qvel[:, plant.qvel] = qpos, qvel
            ctrl, applied = simulations.bind("ctrl"), simulations.bind("xfrc_applied")
            for control, force in zip(controls, forces, strict=True):
                ctrl[:, plant.ctrl], applied[:, plant.body, :3] = control, force
                simulations.step(nstep=substeps)

        return run


def main(config: Config) -> dict[str, Any]:
    counts = (64,) if config.quick else config.simulations
    rounds, trials = (2, 500) if config.quick else (config.rounds, config.trials)
    threads = (1, 2) if processors() > 1 else (1,)
    result = opening(config) | {"robots": {}}
    contests = {name: Contest(name, config.seed) for name in ls.scenarios.names()}
    for name, contest in {} if config.laws_only else contests.items():
        result["robots"][name] = {str(count): throughput(contest, count, threads, rounds) for count in counts}
    result["making"] = making(contests, rounds)
    if not config.laws_only:
        result["many"] = many(contests["quadrotor"], trials, counts[0], threads[-1], rounds)
    return result


def throughput(contest: Contest, count: int, threads: tuple[int, ...], rounds: int) -> dict[str, Any]:
    """Seconds of a batch, by who and with how many threads."""
    rollout = contest.closed_loop(count, 1)  # compile
    contestants: dict[str, Callable[[None], float]] = {}
    for number in threads:
        contestants[f"raw, {number}"] = timed(contest.raw(rollout, number))
        contestants[f"closed loop, {number}"] = timed(lambda number=number: contest.closed_loop(count, number))
    contest.closed_loop(count, 1, controller=contest.law)
    contestants["with a filter, 1"] = timed(lambda: contest.closed_loop(count, 1, controller=contest.law))
    turns = take_turns(contestants, [None], rounds, f"{contest.scenario.name}, {count}")
    seconds = {who: taken[0] for who, taken in turns.items()}
    steps = rollout.plan.steps * contest.plant.substeps(rollout.plan.dt)
    share = [raw / loop for raw, loop in zip(seconds["raw, 1"], seconds["closed loop, 1"], strict=True)]
    filtered = [raw / loop for raw, loop in zip(seconds["raw, 1"], seconds["with a filter, 1"], strict=True)]
    found: dict[str, Any] = {
        "seconds": seconds, "steps": steps, "share": median(share), "share with a filter": median(filtered),
    }  # fmt: skip
    if len(threads) > 1:
        pairs = zip(seconds["closed loop, 1"], seconds["closed loop, 2"], strict=True)
        found["two threads"] = median(one / two for one, two in pairs)
    return found


def making(contests: dict[str, Contest], rounds: int) -> dict[str, float]:
    """Milliseconds of processor time, medians."""
    makers: dict[str, Callable[[], object]] = {}
    for robot, contest in contests.items():
        problem, solution = contest.scenario.problem, contest.solution
        units = problem.dynamics.state_coordinates.units
        tolerate = {unit: number for unit, number in TOLERATED.items() if unit in units}
        for level in ("light", "moderate", "severe"):
            stated = ls.uncertainty_of(contest.plant, ls.disturbances.preset(level, contest.plant))
            track, offset_free = partial(ls.track, problem, solution), partial(ls.OffsetFree, problem, solution, stated)
            if level == "light":
                makers[f"track, {robot}, tolerances given"] = partial(track, tolerate=tolerate)
                makers[f"OffsetFree, {robot}, {level}, tolerances given"] = partial(offset_free, tolerate=tolerate)
            makers[f"track, {robot}, {level}, tolerances chosen"] = partial(track, uncertainty=stated)
            makers[f"OffsetFree, {robot}, {level}, tolerances chosen"] = offset_free
    for make in makers.values():
        make()  # compile
    contestants = {what: timed(make, time.process_time) for what, make in makers.items()}
    turns = take_turns(contestants, [None], 3 * rounds, "laws")
    return {what: 1e3 * median(taken[0]) for what, taken in turns.items()}


def timed(run: Callable[[], object], now: Callable[[], float] = time.perf_counter) -> Callable[[None], float]:
    def once(_: None) -> float:
        clock = now()
        run()
        return now() - clock

    return once


def many(contest: Contest, trials: int, size: int, threads: int, rounds: int) -> dict[str, Any]:
    """Many trials, batch by batch, against raw steps, and the most memory that this process ever had.

    As many batches run at once as there are threads, each on one: what Python does for one, MuJoCo does meanwhile for
    the others.
    """
    rollout = contest.closed_loop(size, 1)
    raw = contest.raw(rollout, threads)
    batches = -(-trials // size)

    def one_batch(number: int) -> None:
        contest.closed_loop(min(size, trials - number * size), 1, number * size)

    def all_trials() -> None:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(one_batch, range(batches)))

    def all_steps() -> None:
        for _ in range(batches):
            raw()

    contestants = {"raw": timed(all_steps), "closed loop": timed(all_trials)}
    turns = take_turns(contestants, [None], min(rounds, 3), f"{trials} trials")
    seconds = {who: taken[0] for who, taken in turns.items()}
    # The last batch of raw steps is whole.
    shares = [
        loop / (raw * trials / (batches * size))
        for raw, loop in zip(seconds["raw"], seconds["closed loop"], strict=True)
    ]
    unit = 1 if sys.platform == "darwin" else 1024
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
    return {"trials": trials, "threads": threads, "seconds": seconds, "ratio": median(shares), "memory": memory}


def report(result: dict[str, Any]) -> str:
    heads = f"{'':<20} {'at once':>8} {'raw us/step':>12} {'closed loop':>12} {'share':>7} {'2 threads':>10}"
    rows = [heads] if result["robots"] else []
    for name, sizes in result["robots"].items():
        for count, found in sizes.items():
            steps = int(count) * found["steps"]
            each = [1e6 * median(found["seconds"][f"{who}, 1"]) / steps for who in ("raw", "closed loop")]
            twice = f"{found['two threads']:>10.2f}" if "two threads" in found else f"{'-':>10}"
            rows.append(f"{name:<20} {count:>8} {each[0]:>12.2f} {each[1]:>12.2f} {found['share']:>7.3f} {twice}")
            with_filter = found["share with a filter"]
            rows.append(f"  with a Kalman filter in the loop {with_filter:.3f}")
            if int(count) >= FULL:
                rows.append(f"  {judge(with_filter >= LEAST_WITH_FILTER, f'that share >= {LEAST_WITH_FILTER:g}')}")
                rows.append(f"  {judge(found['share'] >= LEAST, f'a share >= {LEAST:g}')}")
                if "two threads" in found:
                    rows.append(f"  {judge(found['two threads'] >= TWICE, f'two threads >= {TWICE:g}')}")
    if found := result.get("many"):
        raw, loop = (median(found["seconds"][who]) for who in ("raw", "closed loop"))
        rows += [
            f"{found['trials']} trials of the quadrotor, {found['threads']} threads: {loop:.1f} s, raw {raw:.1f} s,"
            f" ratio {found['ratio']:.3f}  {judge(found['ratio'] <= MOST, f'<= {MOST:g}')}",
            f"memory at most {found['memory']:.2f} GB  {judge(found['memory'] < MEMORY, f'< {MEMORY:g}')}",
        ]
    rows += [
        f"{name}: {took:.1f} ms of processor time"
        + (f"  {judge(took <= SOON[name], f'<= {SOON[name]:g}')}" if name in SOON else "")
        for name, took in result["making"].items()
    ]
    return "\n".join(rows)


if __name__ == "__main__":
    run(Config, main, report, __doc__)
