"""How long compiling takes, in fresh processes, beside another checkout; and for which instructions to compile.

    python experiments/benchmark_compiling.py                              # everything, some minutes
    python experiments/benchmark_compiling.py --before ../before           # another checkout in a column of its own
    python experiments/benchmark_compiling.py --sections known features    # some of it
    python experiments/benchmark_compiling.py --quick                      # bounded, and too short to trust

Times of the first two sections are processor seconds of the process, with all its threads, from before `import lqrsim`
to the solution; the start of Python itself is not in them. Both checkouts run with the packages of this one, each with
caches of its own. Their modules are compiled to Python's bytecode before anything is timed.

first     The first solution of a problem. The cache is empty, or holds only what the problem named before it left: the
          pendulum for a second one with other dynamics of the same size, the quadrotor for the same with a clearance.
          "Compiling" is what this process took longer than the same one with the cache that it left: machine code, and
          derivatives of formulas. The processes after that are as many as --processes says, and their median counts.
known     A problem that is in the cache, in a fresh process, and `lqrsim --help`: medians.
features  Time of an iteration of the quadrotor (primal form, begun as in the paper, its stop test) in the compiled
          loop, compiled for several sets of instructions; see $LQRSIM_CPU_FEATURES. Each set has its turn in processes
          of its own, in which the C++ reference of benchmark_solver.py has its turn at each query; without a reference
          its columns are left out. Of this checkout only.
"""

import compileall
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from runner import Settings, at_most, opening, run
from tqdm import tqdm

Section = Literal["first", "known", "features"]
HERE = Path(__file__).resolve().parent

# What is solved one after the other with one cache, which is empty at first; by names of compile_times/problems.py.
CHAINS = (("pendulum", "second pendulum"), ("quadrotor", "quadrotor, clearance"), ("drive",), ("cart-pole, MJCF",))
KNOWN = ("pendulum", "drive", "quadrotor", "cart-pole, MJCF")
HELP = "lqrsim --help"

# What is to be met, in processor seconds.
TARGETS_WHOLE = {"pendulum": 2.5, "quadrotor": 5.0}
TARGETS_COMPILING = {"second pendulum": 0.5, "quadrotor, clearance": 1.2}
TARGET_KNOWN = 0.5


@dataclass(frozen=True, kw_only=True)
class Config(Settings):
    """What is measured."""

    sections: tuple[Section, ...] = get_args(Section)
    """Which of them."""
    before: Path | None = None
    """Folder of another checkout to measure, too."""
    repeats: int = 1
    """How often everything is compiled; medians count. One time can be off by a tenth, or more on a busy machine."""
    processes: int = 5
    """Processes whose median counts, where the cache is warm."""
    queries: int = 20
    """Of the quadrotor, for each set of instructions."""
    rounds: int = 5
    """Processes that each set of instructions has in turn."""
    reference: Path | None = None
    """Folder of the C++ reference; by default as benchmark_solver.py finds it."""


def main(config: Config) -> dict[str, Any]:
    config = at_most(config, repeats=1, processes=1, queries=2, rounds=1)
    result = opening(config)
    folders = {"now": HERE.parent} | ({"before": config.before.resolve()} if config.before else {})
    for folder in folders.values():
        if not (folder / "lqrsim" / "__init__.py").is_file():
            raise SystemExit(f"checkout: got {folder}, want a folder with lqrsim/ in it")
        compileall.compile_dir(folder / "lqrsim", quiet=2)
    compileall.compile_dir(HERE / "compile_times", quiet=2)
    if "first" in config.sections:
        result["first"] = first(config, folders)
    if "known" in config.sections:
        result["known"] = known(config, folders)
    if "features" in config.sections:
        result["features"] = features(config)
    return result


def first(config: Config, folders: dict[str, Path]) -> dict[str, Any]:
    """By problem and checkout: each time seconds of the process that compiles, and of those after it."""
    chains = CHAINS[:1] if config.quick else CHAINS
    found: dict[str, Any] = {name: {which: [] for which in folders} for chain in chains for name in chain}
    jobs = config.repeats * list(itertools.product(chains, folders.items()))
    for chain, (which, folder) in _progress(jobs, "first"):
        with tempfile.TemporaryDirectory() as cache:
            for name in chain:
                whole = _seconds(folder, cache, name)
                after = [_seconds(folder, cache, name) for _ in range(config.processes)]
                one = {"whole": whole, "after": after, "compiling": whole - statistics.median(after)}
                found[name][which].append(one)
    return found


def known(config: Config, folders: dict[str, Path]) -> dict[str, Any]:
    """By problem and checkout: seconds of each process. The checkouts take turns."""
    names = (*KNOWN[: 1 if config.quick else None], HELP)
    found: dict[str, Any] = {name: {which: [] for which in folders} for name in names}
    with tempfile.TemporaryDirectory() as kept:
        for place in _progress(range(config.processes + 1), "known"):
            for name in names:
                for which, folder in folders.items():
                    seconds = _seconds(folder, str(Path(kept) / which), name)
                    if place > 0:  # the first one compiles
                        found[name][which].append(seconds)
    return found


def features(config: Config) -> dict[str, Any]:
    """By set of instructions: seconds of an iteration, ours and the reference's, by process and query."""
    import llvmlite.binding as llvm

    host = llvm.get_host_cpu_features().flatten()
    sets = {
        "default": None,
        "this processor's, +prefer-256-bit": f"{host},+prefer-256-bit",
        "this processor's, -avx512f": f"{host},-avx512f",
        "this processor's": host,
    }
    rows: dict[str, Any] = {name: {"ours": [], "reference": []} for name in sets}
    found: dict[str, Any] = {"avx512": "+avx512f" in host.split(","), "rows": rows}
    given = str(config.reference.resolve()) if config.reference else None
    work = f"from compile_times.against_cpp import measure\nresult = measure({config.queries}, {given!r})"
    order = list(enumerate(sets))
    with tempfile.TemporaryDirectory() as kept:
        for _ in _progress(range(config.rounds), "features"):
            for place, name in order:
                environment = {key: value for key, value in os.environ.items() if not key.startswith("LQRSIM_CPU_")}
                chosen = sets[name]
                environment |= {} if chosen is None else {"LQRSIM_CPU_FEATURES": chosen}
                one = _process(HERE.parent, str(Path(kept) / str(place)), work, environment)
                for who in ("ours", "reference"):
                    rows[name][who].append(one[who])
                found |= {"skipped": one["skipped"]} if "skipped" in one else {}
            order = order[1:] + order[:1]
    return found


def _progress(what: Iterable[Any], name: str) -> Iterable[Any]:
    return tqdm(what, desc=name, leave=False, delay=2.0, disable=None)


_SHOW_HELP = """
from lqrsim.cli import main
try:
    main(["--help"])
except SystemExit:
    pass
"""


def _seconds(folder: Path, cache: str, name: str) -> float:
    """Processor seconds of a fresh process that solves a problem, or shows the help."""
    work = _SHOW_HELP if name == HELP else f"from compile_times.problems import solve\nsolve({name!r})"
    timed = f"import time\nclock = time.process_time()\n{work}\nresult = time.process_time() - clock"
    return _process(folder, cache, timed, dict(os.environ))


def _process(folder: Path, cache: str, work: str, environment: dict[str, str]) -> Any:
    """The `result` of some code that runs in a process of its own, with the checkout of a folder."""
    code = f"{work}\nimport json, lqrsim\nprint()\nprint(json.dumps([lqrsim.__file__, result]))"
    environment |= {"LQRSIM_CACHE_DIR": cache, "PYTHONPATH": os.pathsep.join([str(folder), str(HERE)])}
    # -P: or the folder that this runs in would come before the checkout.
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"checkout: {folder} failed with exit code {done.returncode}: {done.stderr.strip()}")
    used, result = json.loads(done.stdout.splitlines()[-1])
    if not Path(used).resolve().is_relative_to(folder):
        raise SystemExit(f"checkout: {folder} was not used, but {used}")
    return result


def report(result: dict[str, Any]) -> str:
    tables = {"first": _first_table, "known": _known_table, "features": _features_table}
    parts = [table(result[name]) for name, table in tables.items() if name in result]
    return "\n\n".join([result["machine"], *parts])


def _first_table(found: dict[str, Any]) -> str:
    head = f"{'target':>8} {'now':>7} {'before':>7}"
    lines = [
        "first: processor seconds of a fresh process that compiles",
        f"  {'':<22} {'import to solution':>24}     {'of these, compiling':>24}",
        f"  {'':<22} {head}     {head}",
    ]
    for name, one in found.items():
        cells, verdict = [], ""
        for part, targets in (("whole", TARGETS_WHOLE), ("compiling", TARGETS_COMPILING)):
            taken = {which: statistics.median(time[part] for time in times) for which, times in one.items()}
            cells.append(_cells(targets.get(name), taken))
            if name in targets:
                verdict = "  met" if taken["now"] <= targets[name] else "  MISSED"
        lines.append(f"  {name:<22} {'     '.join(cells)}{verdict}")
    lines.append("  second pendulum: with the cache that the pendulum left; clearance: with the quadrotor's")
    return "\n".join(lines)


def _known_table(found: dict[str, Any]) -> str:
    lines = [
        "known: processor seconds of a fresh process with a warm cache, import to solution",
        f"  {'':<22} {'target':>8} {'now':>7} {'before':>7}",
    ]
    for name, one in found.items():
        taken = {which: statistics.median(times) for which, times in one.items()}
        target = None if name == HELP else TARGET_KNOWN
        verdict = "" if target is None else "  met" if taken["now"] <= target else "  MISSED"
        lines.append(f"  {name:<22} {_cells(target, taken)}{verdict}")
    return "\n".join(lines)


def _cells(target: float | None, taken: dict[str, float]) -> str:
    before = f"{taken['before']:.2f}" if "before" in taken else "-"
    return f"{'-' if target is None else f'{target:g}':>8} {taken['now']:>7.2f} {before:>7}"


def _features_table(found: dict[str, Any]) -> str:
    with_reference = "skipped" not in found
    head = f" {'C++':>9} {'times the C++':>14}   processes" if with_reference else ""
    lines = ["features: ms of an iteration in the compiled loop, median", f"  {'':<34} {'lqrsim':>9}{head}"]
    for name, one in found["rows"].items():
        line = f"  {name:<34} {_milliseconds(one['ours']):>9.4f}"
        if with_reference:
            ratios = [
                [ours / theirs for ours, theirs in zip(*pair, strict=True)]
                for pair in zip(one["ours"], one["reference"], strict=True)
            ]
            each = [statistics.median(process) for process in ratios]
            ratio = statistics.median(itertools.chain.from_iterable(ratios))
            line += f" {_milliseconds(one['reference']):>9.4f} {ratio:>14.3f}   {min(each):.3f} to {max(each):.3f}"
        lines.append(line)
    if not with_reference:
        lines.append(f"  C++: skipped: {found['skipped']}")
    if not found["avx512"]:
        lines.append("  this processor has no AVX-512: all of them are the same")
    return "\n".join(lines)


def _milliseconds(processes: list[list[float]]) -> float:
    return 1e3 * statistics.median(itertools.chain.from_iterable(processes))


if __name__ == "__main__":
    run(Config, main, report, __doc__)
