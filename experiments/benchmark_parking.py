"""Parking with none, one and two trailers: whether what the solver says is so, where it is known beforehand.

    python experiments/benchmark_parking.py                  # 2,000 problems, each for 10 s at most
    python experiments/benchmark_parking.py --problems 200   # the first of them
    python experiments/benchmark_parking.py --only 17        # that one, with all that is said about it
    python experiments/benchmark_parking.py --keep F.json    # what is done is in F.json: the same command goes on there
    python experiments/benchmark_parking.py --quick          # 24 problems: too few to trust

A quarter of the problems have no plan, by a proof that needs no solver; of the others one is known, and kept with the
case. Plans are judged in NumPy alone: parking/judge.py. A share of those that are said to be optimal is tried for a
cheaper plan beside it: parking/descent.py.

right             CONVERGED and nothing about it is false; INFEASIBLE where there is no plan.
false CONVERGED   The plan misses what it has to keep, or there is a cheaper one beside it.
false INFEASIBLE  A plan is known.
unsolved          Any other status: honest, and no answer.
raised            An exception.
"""

import dataclasses
import json
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, get_args

from parking import cases
from parking.outcomes import Outcome, Verdict, look
from runner import Settings, at_most, opening, run
from tqdm import tqdm

from lqrsim.errors import InputError
from lqrsim.machine import processors
from lqrsim.results.archive import replacing


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    problems: int = 2000
    """How many: those of the numbers below."""
    only: tuple[int, ...] = ()
    """The numbers of the problems in place of that."""
    seed: int = 0
    """Of the problems."""
    time_limit: float = 10.0
    """Of each solve in seconds."""
    max_iterations: int = 500
    """Of each solve. With more of them more say INFEASIBLE."""
    tried: int = 10
    """Every how manieth is tried for a cheaper plan, if it is said to be optimal; with `only` each."""
    workers: int | None = None
    """How many processes; by default as many as there are processors."""
    keep: Path | None = None
    """File of the outcomes so far."""


def main(config: Config) -> dict[str, Any]:
    if config.quick:
        config = dataclasses.replace(at_most(config, problems=24), workers=1)
    numbers = config.only or range(config.problems)
    found = _kept(config)
    left = [number for number in numbers if number not in found]
    with tqdm(total=len(numbers), initial=len(numbers) - len(left), desc="parking", disable=None) as bar:
        for outcome in _solved(config, left) if left else ():
            found[outcome.number] = asdict(outcome)
            if config.keep is not None:
                with replacing(config.keep) as unfinished:
                    kept = {"config": _asked(config), "outcomes": list(found.values())}
                    unfinished.write_text(json.dumps(kept) + "\n", encoding="utf-8")
            bar.update()
    return opening(config) | {"outcomes": [found[number] for number in numbers]}


def _asked(config: Config) -> dict[str, Any]:
    """What an outcome depends on."""
    return {name: getattr(config, name) for name in ("seed", "time_limit", "max_iterations", "tried")}


def _kept(config: Config) -> dict[int, dict[str, Any]]:
    """The outcomes of an earlier run by number. Raises InputError if that had other settings."""
    if config.keep is None or not config.keep.is_file():
        return {}
    kept = json.loads(config.keep.read_text("utf-8"))
    if kept["config"] != _asked(config):
        raise InputError(f"--keep: got outcomes for {kept['config']}, want those for {_asked(config)}")
    return {row["number"]: row for row in kept["outcomes"]}


def _look(config: Config, number: int) -> Outcome:
    limits = {"time_limit": config.time_limit, "max_iterations": config.max_iterations}
    return look(number, seed=config.seed, improve=number % config.tried == 0, **limits)


def _solved(config: Config, numbers: Iterable[int]) -> Iterator[Outcome]:
    one = partial(_look, dataclasses.replace(config, tried=1) if config.only else config)
    workers = processors() if config.workers is None else config.workers
    if workers == 1 or config.only:
        yield from map(one, numbers)
        return
    # One after the other, so that each structure is compiled once before all begin.
    known: set[tuple[int, bool, bool]] = set()
    for number in tqdm(range(24), desc="compiling", leave=False, disable=None):
        task = cases.draw(number, seed=config.seed).task
        if (structure := (len(task.trailers), task.exact, task.repulsion is None)) not in known:
            known.add(structure)
            one(number)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(one, numbers, chunksize=4)


def false(result: dict[str, Any]) -> list[dict[str, Any]]:
    """The outcomes that no solver should have."""
    return [row for row in result["outcomes"] if row["verdict"] not in ("right", "unsolved")]


def report(result: dict[str, Any]) -> str:
    rows, verdicts = result["outcomes"], get_args(Verdict)
    features = sorted({feature for row in rows for feature in row["features"]}, key=_place)
    width = max((len(feature) for feature in features), default=0)
    heads = " ".join(f"{verdict:>16}" for verdict in verdicts)
    lines = [f"{'':<{width}} {'cases':>6} {heads} {'iterations':>11} {'ms':>8}"]
    for feature in features:
        own = [row for row in rows if feature in row["features"]]
        counts = Counter(row["verdict"] for row in own)
        shares = " ".join(f"{counts[one]:>6} ({100 * counts[one] / len(own):>5.1f} %)" for one in verdicts)
        solved = [row for row in own if row["verdict"] == "right"]
        iterations, milliseconds = (_median(row[key] for row in solved) for key in ("iterations", "milliseconds"))
        lines.append(f"{feature:<{width}} {len(own):>6} {shares} {iterations:>11.4g} {milliseconds:>8.4g}")
    lines.append("iterations and ms are medians of the right ones")
    asked = result["config"]
    limits = f"--max-iterations {asked['max_iterations']} --time-limit {asked['time_limit']:g}"
    unsolved = [row for row in rows if row["verdict"] == "unsolved"]
    for status, count in Counter(row["status"] for row in unsolved).most_common():
        known = [row for row in unsolved if row["status"] == status and "possible" in row["features"]]
        numbers = " ".join(str(row["number"]) for row in known)
        lines.append(f"unsolved, {status}: {count}; those with a plan: {numbers}")
    for row in false(result):
        again = f"python experiments/benchmark_parking.py --seed {row['seed']} --only {row['number']} {limits}"
        lines.append(f"{row['verdict']}: {', '.join(row['features'][1:])}: {row['said']}\n  {again}")
    if asked["only"]:
        lines += [f"{key:<12} {value}" for row in rows for key, value in row.items()]
    return "\n".join(lines)


def _place(feature: str) -> tuple[bool, bool, str]:
    """All that are possible first."""
    return feature.startswith("impossible"), feature != "possible", feature


def _median(values: Iterable[float]) -> float:
    listed = list(values)
    return statistics.median(listed) if listed else float("nan")


if __name__ == "__main__":
    run(Config, main, report, __doc__, failures=false)
