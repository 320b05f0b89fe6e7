"""Hostile calls of every public signature: each is to be accepted, or refused by one clear line of InputError.

Each call takes valid arguments (`subjects.py`) and replaces one or several by something hostile (`hostile.py`); what
is accepted is then asked for all that it has. Calls run in a process of their own, with a limit of memory and of time:
what hangs or dies there is counted, and the process that counts goes on.

A verdict is "accepted", "refused" (an InputError of one line of bounded length), "deliberate" (what a user's own
function was told to raise came through as it was), or a failure: "raw" (any other exception), "hang" or "death".
"""

import contextlib
import dataclasses
import inspect
import multiprocessing
import os
import re
import signal
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import lqrsim as ls
from lqrsim.errors import LONGEST, InputError
from robustness.common import Hang, limited
from robustness.hostile import Deliberate, spoilt
from robustness.subjects import Subject, subjects

MEMORY = 6 << 30  # bytes that a call may come to use beyond what is used before
PATIENCE = 120.0  # seconds of the processor that a call may take: with what it compiles
WALL = 400.0  # seconds after which a call that takes none of the processor counts as hung, too
HERE = Path(__file__).parent
ADDRESS = re.compile(r"0x[0-9a-fA-F]{6,}")
FAILURES = ("raw", "hang", "death")


@dataclass(frozen=True)
class Verdict:
    """Result of one call; `what` is how it was called, `why` what it raised and where."""

    number: int
    subject: str
    kind: str
    what: str = ""
    why: str = ""

    @property
    def failed(self) -> bool:
        """Whether it is none of the answers that a call may get."""
        return self.kind in FAILURES


class Caller:
    """Makes call number i of a seed: the same call wherever it is made."""

    def __init__(self, folder: Path, seed: int, only: str = "") -> None:
        os.chdir(folder)
        self.seed = seed
        self.subjects = {name: one for name, one in subjects(folder).items() if only in name}
        self._others = [one for name, subject in self.subjects.items() for one in subject.arguments.values()]
        weights = np.array([subject.weight for subject in self.subjects.values()])
        self._shares = weights / weights.sum()

    def __call__(self, number: int) -> Verdict:
        rng = np.random.default_rng([self.seed, number])
        name = list(self.subjects)[rng.choice(len(self.subjects), p=self._shares)]
        subject, what = self.subjects[name], ""
        try:
            with limited(PATIENCE), warnings.catch_warnings(), open(os.devnull, "w") as nowhere:
                warnings.simplefilter("ignore")
                with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
                    arguments = self._arguments(rng, subject)
                    what = shown(arguments, subject.arguments)
                    made = subject.call(**arguments)
                    exercise(made)
                    addressed = printed_address(made)
        except InputError as error:
            line = str(error)
            good = 0 < len(line) <= LONGEST and len(line.splitlines()) == 1 and not ADDRESS.search(line)
            return Verdict(number, name, "refused" if good else "raw", what, line)
        except Deliberate:
            return Verdict(number, name, "deliberate", what)
        except Hang as error:
            return Verdict(number, name, "hang", what, where(error))
        except Exception as error:
            own = Path(traceback.extract_tb(error.__traceback__)[-1].filename).parent == HERE
            return Verdict(number, name, "deliberate" if own else "raw", what, where(error))
        return Verdict(number, name, "raw" if addressed else "accepted", what, addressed)

    def _arguments(self, rng: np.random.Generator, subject: Subject) -> dict[str, Any]:
        arguments = dict(subject.arguments)
        names = list(arguments)
        several = min(len(names), 1 if rng.random() < 0.7 else 2)
        for name in rng.choice(names, size=several, replace=False) if names else ():
            arguments[name] = spoilt(rng, arguments[name], self._others)
        return arguments


def printed_address(made: Any) -> str:
    """The text of a result that names an object by its address in memory; empty if it does not.

    What Python or a dataclass prints by itself is not the package's text.
    """
    own = type(made).__module__.partition(".")[0] == "lqrsim" and not isinstance(made, type)
    plain = dataclasses.is_dataclass(made) or type(made).__repr__ is object.__repr__
    texts = [str(made)] * (own and not (plain and type(made).__str__ is object.__str__))
    return next((text[:400] for text in texts if ADDRESS.search(text)), "")


def exercise(made: Any) -> None:
    """Read all properties of a result, and call its methods without arguments."""
    # Results and paths do things to files when asked.
    if type(made).__module__.partition(".")[0] != "lqrsim" or isinstance(made, (ls.stress.Results, Path)):
        if inspect.isgenerator(made):
            list(made)
        return
    _ = str(made), repr(made)
    for name, item in inspect.getmembers_static(type(made)):
        if (name[0] == "_" and name != "__len__") or name in getattr(type(made), "__dataclass_fields__", ()):
            continue
        with contextlib.suppress(InputError):  # an answer, as that a solution of ilqr has no total cost
            if inspect.isfunction(item) and len(inspect.signature(item).parameters) == 1:
                getattr(made, name)()
            elif isinstance(item, property) or type(item).__name__ == "cached_property":
                getattr(made, name)


def shown(arguments: dict[str, Any], valid: Any) -> str:
    """The arguments that were replaced, in a line."""
    changed = []
    for name, value in arguments.items():
        if value is not valid[name]:
            try:
                text = " ".join(repr(value).split())
            except Exception:
                text = f"<a {type(value).__name__}>"
            changed.append(f"{name}={text[:100]}")
    return ", ".join(changed)


def where(error: BaseException) -> str:
    """What was raised, and the place in lqrsim from which it came."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "lqrsim" in frame.filename]
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
    try:
        text = " ".join(str(error).split())[:160]
    except Exception:
        text = ""
    return f"{type(error).__name__}: {text} at {place}"


def work(connection: Any, seed: int, only: str, numbers: range) -> None:
    """The process that makes the calls: reports the number of each before it starts, and its verdict."""
    import resource

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with tempfile.TemporaryDirectory() as folder:
        caller = Caller(Path(folder).resolve(), seed, only)
        used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))
        connection.send("ready")
        for number in numbers:
            connection.send(number)
            connection.send(caller(number))
        os.chdir("/")
    connection.send("done")


def calls(count: int, *, seed: int = 0, only: str = "", first: int = 0) -> Iterator[Verdict]:
    """Verdicts of hostile calls, made in a process that is restarted if it dies."""
    context, number = multiprocessing.get_context("spawn"), first
    while number < first + count:
        here, there = context.Pipe()
        process = context.Process(target=work, args=(there, seed, only, range(number, first + count)), daemon=False)
        process.start()
        there.close()
        begun = None
        try:
            while True:
                if not here.poll(WALL):
                    yield Verdict(begun or number, only, "hang", why=f"more than {WALL:g} s")
                    break
                told = here.recv()
                if told == "done":
                    begun = first + count
                    break
                if isinstance(told, Verdict):
                    number = told.number + 1
                    yield told
                elif told != "ready":
                    begun = told
        except EOFError:
            process.join()
            if begun is None:
                raise RuntimeError(f"the process that makes the calls ended with {process.exitcode}") from None
            yield Verdict(begun, only, "death", why=f"the process ended with {process.exitcode}")
        finally:
            process.kill()
            process.join()
        if begun is None:
            return
        number = begun if begun >= first + count else begun + 1


def measure(config: Any) -> dict[str, Any]:
    """Counts of verdicts, of all and by subject, and each failure with the number that repeats it."""
    kinds: Counter[str] = Counter()
    tried: set[str] = set()
    failures = []
    for verdict in calls(config.calls, seed=config.seed, only=config.only, first=config.first):
        kinds[verdict.kind] += 1
        tried.add(verdict.subject)
        if verdict.failed:
            failures.append(dataclasses.asdict(verdict))
    return {"calls": kinds.total(), "subjects": len(tried), "kinds": dict(kinds), "failures": failures}


def report(result: dict[str, Any]) -> list[str]:
    """The counts, and each failure with how to repeat it."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(result["kinds"].items()))
    lines = [f"api: {result['calls']} hostile calls of {result['subjects']} public callables: {kinds}"]
    lines += [
        f"  {one['kind']} at --first {one['number']} --calls 1: {one['subject']}({one['what']}): {one['why']}"
        for one in result["failures"]
    ]
    return ["\n".join([*lines, f"  {len(result['failures'])} raw exceptions, hangs and deaths"])]
