"""Reproduction of the paper: one script per result, run one after the other, and a page with a summary."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lqrsim.commands import console
from lqrsim.errors import check_name
from lqrsim.machine import description
from lqrsim.reports.paper import ScriptResult, results_page, verdicts
from lqrsim.results.save_load import replacing

# In the wheel experiments/ lies inside the package, in the repository beside it.
_PACKAGED = [Path(__file__).parents[1] / "experiments", Path(__file__).parents[2] / "experiments"]
EXPERIMENTS = next((folder for folder in _PACKAGED if folder.is_dir()), _PACKAGED[0])

# In the order of the page. With --json each prints its result, its report in Markdown, and its statements.
SCRIPTS = (
    "figure_2",
    "figure_3",
    "table_1",
    "convergence",
    "state_dimension",
    "state_of_the_art",
    "feedback",
    "stress_test",
    "robust_policies",
    "noise_aware",
    "funnels",
    "solver_league",
)

TIDYING = 20.0  # s

# Runs a script as usual, but a signal lets it remove unfinished files, and end silently.
_START = "import sys; from lqrsim.process import run_script; run_script(sys.argv[1:])"


@dataclass(frozen=True)
class Failure:
    """A script that failed."""

    script: str
    code: int


def reproduce(scripts: Sequence[str], *, out: Path, quick: bool) -> int:
    """Run the scripts, write `results.md`, `results.json` and the figures, and print which statements hold.

    Args:
      scripts: names in `SCRIPTS`; none means all.
      out: output folder.
      quick: run a small part of each.

    Returns:
      1 if a script failed, else 0, whether or not the paper's statements hold.

    Raises:
      InputError: an unknown script, or a folder that cannot be written.
    """
    named = {check_name("results", name, SCRIPTS) for name in scripts} or set(SCRIPTS)
    chosen = [name for name in SCRIPTS if name in named]
    console.check_output("--out", out)
    results: dict[str, ScriptResult] = {}
    failures: list[Failure] = []
    begun = time.monotonic()
    with console.bar(total=len(chosen), desc="reproducing", unit="result", leave=False, disable=None) as bar:
        for name in chosen:
            bar.set_postfix_str(name)
            clock = time.monotonic()
            outcome = _run(name, out, quick=quick)
            seconds = time.monotonic() - clock
            if isinstance(outcome, Failure):
                failures.append(outcome)
                console.say(f"{name}: FAILED with exit code {outcome.code} after {seconds:.0f} s; see above")
            else:
                results[name] = outcome | {"seconds": round(seconds)}
                console.say(f"{name}: {seconds:.0f} s, {len(outcome['result']['figures'])} figures")
            bar.update()
    if results:
        saved = {"machine": description(), "quick": quick, "results": results}
        with replacing(out / "results.json") as unfinished:
            unfinished.write_text(json.dumps(saved, allow_nan=False) + "\n", encoding="utf-8")
        with replacing(out / "results.md") as unfinished:
            unfinished.write_text(results_page(saved), encoding="utf-8")
        console.say("\n" + "\n".join(verdicts(results, out)))
        console.say(f"\ntook {time.monotonic() - begun:.0f} s")
        console.wrote(out / "results.md")
        console.wrote(out / "results.json")
        console.result(**saved)
    for failure in failures:
        console.say(f"FAILED {failure.script}: exit code {failure.code}")
    console.result(failures=failures)
    return 1 if failures else 0


def _run(name: str, out: Path, *, quick: bool) -> ScriptResult | Failure:
    """Run a script in a process of its own, so that scripts do not affect each other. Returns its result."""
    script = EXPERIMENTS / f"{name}.py"
    command = [sys.executable, "-c", _START, script, "--json", "--out", out, *(["--quick"] if quick else [])]
    below = os.environ | {"TQDM_POSITION": "1"}  # its bars go below ours
    with subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, text=True, env=below) as running:
        try:
            printed, _ = running.communicate()
        except BaseException:
            _end(running)
            raise
    try:
        return json.loads(printed) if running.returncode == 0 else Failure(name, running.returncode)
    except ValueError:
        sys.stderr.write(f"{name}: printed something that is not its result:\n{printed[:1000]}\n")
        return Failure(name, running.returncode)


def _end(running: subprocess.Popen[str]) -> None:
    """Stop a script, with time to remove unfinished files. Ctrl-C may have stopped it already."""
    running.terminate()
    try:
        running.wait(TIDYING)
    except subprocess.TimeoutExpired:
        running.kill()
