"""What the commands print: lines, progress and, with `--json`, one object, whose parts docs/json.md describes.

Also an early check that results can be written.
"""

import contextlib
import json
import os
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lqrsim as ls
from lqrsim import process

if TYPE_CHECKING:
    from tqdm import tqdm

Object = dict[str, Any]

LINE_EVERY = 10.0  # s between lines of progress where there is no terminal

# The result that the running command prints with `--json`; None without.
_RESULT: ContextVar[Object | None] = ContextVar("result", default=None)


# The options of `lqrsim solve`, for those of the solver in the texts of remedies.
_OPTIONS = {
    r"\bstart=(solution|\[\.\.\.\])": "--start FILE.npz",
    r'\b(stop|finish)="(\w+)"': r"--\1 \2",
    r"\btime_limit\b": "--time-limit",
    r"\bmax_iterations\b": "--max-iterations",
    r"\bcontrol_limits\b": "--control-limits",
}


def run(command: Any, name: str) -> int:
    """Run a command; returns its exit code. With `--json` it prints one JSON object, and all else to stderr."""
    if not getattr(command, "json", False):
        return command.run()
    result: Object = {"format": f"lqrsim {name}", "version": 1}
    token = _RESULT.set(result)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            result["exit_code"] = command.run()
    finally:
        _RESULT.reset(token)
    print_json(result)
    return result["exit_code"]


def print_json(result: Mapping[str, Any]) -> None:
    """Print one JSON object. Raises process.Unprintable if stdout cannot be written."""
    with process.printing():
        print(text_of(result), flush=True)


def text_of(value: object) -> str:
    """The JSON text of a result in one line, with numbers at full precision."""
    from lqrsim.results.archive import plain  # imports NumPy, which `--help` should not wait for

    return json.dumps(plain(value), allow_nan=False)


def result(**parts: object) -> None:
    """Add to the output of `--json`; without it, do nothing."""
    output = _RESULT.get()
    if output is not None:
        output.update(parts)


def wants_result() -> bool:
    """Whether `--json` was given, for results that take time to compute."""
    return _RESULT.get() is not None


def of_scenario(name: str, scenario: "ls.Scenario") -> Object:
    """A scenario, as in `lqrsim list`."""
    problem = scenario.problem
    return {
        "name": name, "summary": scenario.summary, "robot": scenario.robot.name, "scene": scenario.scene.name,
        **_fields(problem, "steps dt"), "states": _named(problem.dynamics.state_coordinates),
        "controls": _named(problem.dynamics.control_coordinates),
    }  # fmt: skip


def of_funnel(funnel: "ls.types.Funnel") -> Object:
    """Settings and levels of a funnel; the ellipsoids are in its file."""
    times = [knot * funnel.plan.dt for knot in funnel.knots]
    columns = {
        "knot": funnel.knots, "time": times, "level": funnel.levels, "trials": funnel.trials,
        "successes": funnel.successes, "reason": funnel.reasons,
    }  # fmt: skip
    names = "rate confidence states family goal_radius disturbances seed options simulated policy_digest versions"
    return {**_fields(funnel, names), "knots": rows_of(columns)}


def of_solution(solution: "ls.Solution") -> Object:
    """Status, log and certificate of a solution; the arrays are in its file."""
    plan, target = solution.trajectory, solution.target
    clearance = None
    if solution.clearance is not None:
        knot = int(solution.clearance.argmin())
        clearance = {"least": solution.clearance[knot], "time": plan.times[knot]}
    distance = target.distance(plan.states[-1])
    names = (
        "scenario solver options status success detail remedy cost gap optimality violation certificate iterations"
        " problem_digest versions"
    )
    return {
        **_fields(solution, names),
        **_fields(plan, "steps dt"),
        "clearance": clearance,
        "goal": {"is": target.name, "distance": distance, "radius": solution.goal_radius, "unit": target.unit},
        "candidates": [_fields(candidate, "start cost iterations status") for candidate in solution.candidates],
    }


def of_rollout(rollout: "ls.Rollout", problem: "ls.Problem | None" = None) -> Object:
    """The outcomes of a rollout's trials. Costs are left out unless a problem with the same steps and dt is given."""
    from lqrsim.stress.analysis import outcomes

    if problem is not None and (problem.steps, problem.dt) != (rollout.plan.steps, rollout.plan.dt):
        problem = None
    columns: Mapping[str, Any] = {**outcomes(rollout, problem).columns(), "reason": rollout.reasons}
    target, chance = rollout.target, rollout.collision_chance
    return {
        **_fields(rollout, "robot scene disturbances seed tracking_unit versions"),
        "goal": {"is": target.name, "radius": rollout.goal_radius, "unit": target.unit},
        "departure": rollout.departure() or None,
        "warned": rollout.warned() or None,
        "tube": rollout.tube is not None,
        "collision_chance": None if chance is None else chance.max(),
        "reached": rollout.reached.sum(),
        "trials": rows_of(columns),
    }


def of_campaign(results: "ls.stress.Results") -> Object:
    """The outcomes of each cell of a campaign so far."""
    from lqrsim.results.goal import OUTCOMES

    cells = []
    for cell, so_far in results.cell_summaries().items():
        row = {**_fields(cell, "policy sweep strength"), "trials": so_far.tally.total()}
        if (success := so_far.success) is not None:
            outcomes = {name: so_far.tally[name] for name in OUTCOMES}
            row |= {"outcomes": outcomes, "reached": success.exact, "deterministic": success.alike}
        cells.append(row)
    return {
        **_fields(results, "folder complete"),
        "cells": cells,
        "left_out": results.manifest.left_out,
        "plans": results.plans(),
        "stop_reasons": results.stop_reasons(),
        "versions": results.manifest.versions,
    }


def _fields(record: object, names: str) -> Object:
    return {name: getattr(record, name) for name in names.split()}


def rows_of(columns: Mapping[str, Any]) -> list[Object]:
    """A table as a list of rows: column name -> value."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _named(space: "ls.types.Coordinates") -> list[Object]:
    return [{"name": name, "unit": unit} for name, unit in zip(space.names, space.units, strict=True)]


def save(result: Any, path: Path) -> None:
    """Save a result. An older file of that name is replaced, and the line about it says so."""
    is_older = path.exists()
    wrote(ls.save(result, path), remark=" in place of an older one" if is_older else "")


def wrote(path: Path, *, remark: str = "") -> None:
    """Say that a file or folder was written."""
    say(f"wrote {path}{remark}")
    output = _RESULT.get()
    if output is not None:
        output.setdefault("wrote", []).append(path)


def say(text: str = "") -> None:
    """Print immediately, even to a file or a pipe, and above any progress bar. Raises process.Unprintable."""
    bars = sys.modules.get("tqdm")
    with process.printing():
        if bars is None:
            print(text, flush=True)
        else:
            bars.tqdm.write(text)
            sys.stdout.flush()


def check_output(field: str, path: Path, kind: str = "folder", *, suffixes: Collection[str] = ()) -> None:
    """Check before the work starts that a folder or a file, whose name has to end in a suffix, can be written."""
    from lqrsim.errors import check_path
    from lqrsim.results.archive import excerpt_of

    check_path(field, path, "the path of an output", suffixes=suffixes)
    absolute = (path if kind == "folder" else path.parent).absolute()
    existing = next((place for place in (absolute, *absolute.parents) if os.path.exists(place)), absolute)
    try:
        tempfile.TemporaryFile(dir=existing).close()
        with contextlib.suppress(FileNotFoundError):
            os.lstat(path)  # fails for invalid names
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ls.InputError(f"{field}: got {excerpt_of(path)}, want a {kind} that can be written ({reason})") from None


@contextlib.contextmanager
def keeping(write: Callable[[Any], object]) -> Iterator[None]:
    """Run a block. If Ctrl-C ends it and leaves a partial result, call `write` with that; see `process.keeping`."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if (partial_result := getattr(stop, "found", None)) is not None:
            write(partial_result)
        raise


def solve_and_print(scenario: "ls.Scenario", solver: str = "smooth", **options: object) -> "ls.Solution":
    """Solve a scenario; print iterations as they end, then the status. The options are the solver's.

    Of the hundredth to the thousandth iteration every tenth is printed, then every hundredth, and so on.
    """
    from lqrsim.results.solution_parts import Iteration
    from lqrsim.scenarios import solutions

    count = 0

    def show(iteration: Iteration) -> None:
        nonlocal count
        count += 1
        if count % 10 ** max(len(str(count)) - 2, 0) == 0:
            say(iteration.row(count))

    say(Iteration.HEADER)
    solution = solutions.solve(scenario, solver, callback=show, **options)
    say(summary_of(solution))
    return solution


def summary_of(solution: "ls.Solution") -> str:
    """The summary of a solution, whose remedy has the options of `lqrsim solve` where it has those of the solver."""
    remedy = solution.remedy
    for pattern, option in _OPTIONS.items():
        remedy = re.sub(pattern, option, remedy)
    return replace(solution, remedy=remedy).summary()


def load_with_scenario(path: Path, named: str | None) -> "tuple[ls.Solution, ls.Scenario]":
    """The solution in a file, and its scenario: the named one, else its own if `lqrsim list` has it."""
    from lqrsim.scenarios.references import resolve

    solution = ls.load(path, ls.Solution)
    if not named and not solution.scenario:
        raise ls.InputError("--scenario: got none, and the solution names none, want the one with robot and scene")
    return solution, resolve(named or solution.scenario, registered_only=not named).with_duration_of(solution)


def bar(**options: Any) -> "tqdm[Any]":
    """A progress bar, with the options of tqdm."""
    from tqdm import tqdm

    # tqdm's own lock also locks processes: it is a named semaphore, about which Python complains if a signal ends this
    # process.
    tqdm.set_lock(threading.RLock())
    return tqdm(**options)


class Progress(contextlib.AbstractContextManager["Progress"]):
    """The progress of a block: a bar on a terminal, elsewhere occasional lines. Call it with the amount done.

    The first call starts the clock: preparations before it, such as compiling, do not count.
    """

    def __init__(self, what: str, unit: str) -> None:
        self._what, self._unit = what, unit
        self._watched = sys.stderr.isatty()
        self._bar: tqdm[Any] | None = None
        self._begun = self._last_line = 0.0
        self._before = 0

    def __call__(self, done: int, total: int, status: str = "") -> None:
        """Show that `done` of `total` are done, and the result so far."""
        now = time.monotonic()
        if self._bar is None:
            self._begun, self._last_line, self._before = now, now, done
            options: dict[str, Any] = {"initial": done, "leave": False, "delay": 1.0, "disable": not self._watched}
            self._bar = bar(desc=self._what, unit=f" {self._unit}s", total=total, **options)
            if 1 < done < total:  # a campaign that is resumed
                say(f"{done} of {total} {self._unit}s are done, {total - done} to go")
        self._bar.set_postfix_str(status, refresh=False)
        self._bar.update(done - self._bar.n)
        last = done == total and now - self._begun > LINE_EVERY
        if self._watched or not (now - self._last_line > LINE_EVERY or last):
            return
        self._last_line = now
        line = f"{self._what}: {done} of {total} {self._unit}s"
        if done > self._before:
            rate = (done - self._before) / (now - self._begun)
            line += f", {rate:.3g} {self._unit}s/s, {self._bar.format_interval((total - done) / rate)} left"
        say(line + (f"; {status}" if status else ""))

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
