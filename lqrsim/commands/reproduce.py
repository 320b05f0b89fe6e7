"""The command that reproduces the paper: one script per result, run one after the other, and a page with a summary."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lqrsim as ls
from lqrsim.commands import console
from lqrsim.commands.options import Json, optional

# In the wheel, experiments/ is inside the package; in the repository, next to it.
_PACKAGED = [Path(__file__).parents[1] / "experiments", Path(__file__).parents[2] / "experiments"]
EXPERIMENTS = next((folder for folder in _PACKAGED if folder.is_dir()), _PACKAGED[0])

# In the order of the page. With --json each script prints its result, its report in Markdown, and its statements.
SCRIPTS = (
    "figure_2", "figure_3", "table_1", "convergence", "state_dimension", "state_of_the_art", "feedback", "stress_test",
    "robust_policies", "noise_aware", "belief_space", "funnels", "solver_league", "race", "other_simulators",
    "adaptive_quad_bench", "export_c",
)  # fmt: skip

STOP_TIMEOUT = 20.0  # s, time for a stopped script to remove unfinished files
VERDICTS = {True: "holds", False: "**does not hold**", None: "not tested"}

ScriptResult = dict[str, Any]  # output of a script of experiments/ with --json

# Runs a script as usual, but a signal lets it remove unfinished files, and end silently.
_START = "import sys; from lqrsim.process import run_script; run_script(sys.argv[1:])"


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Reproduce the paper's results and check its statements.

    Writes results.md with a summary, results.json with every number, and the figures as png and pdf. Takes some hours,
    the longest being robust_policies and solver_league. Includes other solvers and controllers with the extra
    bench, other simulators with rotorpy and crazyflow, and an emulated board with arm-none-eabi-gcc and
    qemu-system-arm. Programs that are not installed are skipped, and named.

    Exits with 1 if an experiment failed, whether or not the paper's statements hold.
    """

    results: Annotated[
        Positional[tuple[str, ...]], optional("RESULT ...", f"{', '.join(SCRIPTS)}. By default all.")
    ] = ()
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("runs/paper")
    """Output folder."""
    quick: bool = False
    """Run a small part of each, for a first look."""
    keep: bool = False
    """Keep the other results of an earlier run in the folder, and write the page with all of them."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.errors import check_name
        from lqrsim.machine import description
        from lqrsim.results.archive import plain, write_text

        named = {check_name("results", name, SCRIPTS) for name in self.results} or set(SCRIPTS)
        chosen = [name for name in SCRIPTS if name in named]
        out = self.out
        console.check_output("--out", out)
        none = {"machine": description(), "results": {}}
        earlier = _saved(out / "results.json", quick=self.quick) if self.keep else none
        results, failures, begun = dict[str, ScriptResult](), dict[str, int](), time.monotonic()
        with console.bar(total=len(chosen), desc="reproducing", unit="result", leave=False, disable=None) as bar:
            for name in chosen:
                bar.set_postfix_str(name)
                clock = time.monotonic()
                outcome = _run(name, out, quick=self.quick)
                seconds = time.monotonic() - clock
                if isinstance(outcome, int):
                    failures[name] = outcome
                    console.say(f"{name}: FAILED with exit code {outcome} after {seconds:.0f} s; see above")
                else:
                    results[name] = outcome | {"seconds": round(seconds), "machine": description()}
                    console.say(f"{name}: {seconds:.0f} s, {len(outcome['result']['figures'])} figures")
                    for part, reason in _skipped(outcome["result"]):
                        console.say(f"{name}: skipped{part and f' {part}'}: {reason}")
                bar.update()
        if results:
            together = earlier["results"] | results
            ordered = {name: together[name] for name in SCRIPTS if name in together}
            saved = {"machine": earlier["machine"], "quick": self.quick, "results": ordered}
            write_text(out / "results.json", json.dumps(plain(saved), allow_nan=False) + "\n")
            write_text(out / "results.md", results_page(saved))
            console.say("\n" + "\n".join(verdicts(results, out)))
            console.say(f"\ntook {time.monotonic() - begun:.0f} s")
            console.wrote(out / "results.md")
            console.wrote(out / "results.json")
            console.result(**saved)
        for name, code in failures.items():
            console.say(f"FAILED {name}: exit code {code}")
        console.result(failures=[{"script": name, "code": code} for name, code in failures.items()])
        return 1 if failures else 0


def _saved(file: Path, *, quick: bool) -> dict[str, Any]:
    """The results that an earlier call saved. Raises InputError if they cannot be read, or if --quick differs."""
    try:
        saved = json.loads(file.read_text(encoding="utf-8"))
        other = saved["quick"] is not quick
        results_page(saved)  # which needs all that the file should have
    except Exception:  # what it has instead may raise anything
        raise ls.InputError(f"--keep: got {file}, want a file that `lqrsim reproduce` wrote") from None
    if other:
        how = "without" if quick else "with"
        raise ls.InputError(f"--keep: got {file}, written {how} --quick, want the same option")
    return saved


def _run(name: str, out: Path, *, quick: bool) -> ScriptResult | int:
    """Run a script in its own process, so that scripts do not affect each other. Returns its result, or exit code.

    An exception, such as that of Ctrl-C, stops it, with time to remove unfinished files.
    """
    script = EXPERIMENTS / f"{name}.py"
    command = [sys.executable, "-c", _START, script, "--json", "--out", out, *(["--quick"] if quick else [])]
    below = os.environ | {"TQDM_POSITION": "1"}  # its bars go below ours
    with subprocess.Popen([str(part) for part in command], stdout=subprocess.PIPE, text=True, env=below) as running:
        try:
            printed, _ = running.communicate()
        except BaseException:
            running.terminate()
            try:
                running.wait(STOP_TIMEOUT)
            except subprocess.TimeoutExpired:
                running.kill()
            raise
    try:
        return json.loads(printed) if running.returncode == 0 else running.returncode
    except ValueError:
        sys.stderr.write(f"{name}: printed something that is not its result:\n{printed[:1000]}\n")
        return running.returncode


def _skipped(result: Mapping[str, Any], part: str = "") -> Iterator[tuple[str, str]]:
    """The parts of a result that were skipped, "" for all of it, and the reason of each: what is not installed."""
    for key, value in result.items():
        if key == "skipped":
            yield from value.items() if isinstance(value, Mapping) else [(part, value)]
        elif isinstance(value, Mapping):
            yield from _skipped(value, key)


def results_page(saved: Mapping[str, Any]) -> str:
    """All results in Markdown: verdicts on the paper's statements, the runs, and the report of each script."""
    import jinja2

    results: dict[str, ScriptResult] = saved["results"]
    statements = [statement for result in results.values() for statement in result["statements"]]
    versions = next(iter(results.values()))["result"]["versions"]
    sections = list[dict[str, str]]()
    for name, result in results.items():
        run = [f"{result['seconds']} s"]
        # With --keep, a result may be of another version or machine than the page's first lines say.
        used = result["result"]["versions"].items()
        if other := [f"{package} {version}" for package, version in used if versions.get(package) != version]:
            run.append(f"with {' and '.join(other)}")
        if (machine := result.get("machine", saved["machine"])) != saved["machine"]:
            run.append(f"on {machine}")
        sections.append({"name": name, "report": result["report"], "run": ", ".join(run)})
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True)  # Markdown, not HTML
    template = environment.from_string(Path(__file__).with_name("results.md.j2").read_text(encoding="utf-8"))
    return template.render(
        size="a quick run, on a small part of the problems" if saved["quick"] else "a full run",
        options=" --quick" if saved["quick"] else "", machine=saved["machine"], sections=sections,
        versions=", ".join(f"{name} {version}" for name, version in versions.items()), statements=statements,
        count=_count(statements), verdicts=VERDICTS,
    )  # fmt: skip


def _count(statements: Sequence[Mapping[str, Any]]) -> str:
    """Text with the number of statements that hold."""
    counts = {verdict: sum(statement["holds"] is verdict for statement in statements) for verdict in VERDICTS}
    said = f"Of {len(statements)} tests of what the paper says, {counts[True]} hold and {counts[False]} do not"
    return f"{said}; {counts[None]} could not be tested here." if counts[None] else f"{said}."


def verdicts(results: Mapping[str, ScriptResult], out: Path) -> Iterator[str]:
    """Three lines for each statement, for a terminal."""
    statements = [statement for result in results.values() for statement in result["statements"]]
    for statement in statements:
        yield f"{VERDICTS[statement['holds']].strip('*').upper():<14} {statement['where']}: {statement['paper']}"
        yield f"{'':<14} {statement['ours']}  [want: {statement['test']}]"
        yield f"{'':<14} {out / 'figures' / statement['figure']}.png"
    if statements:
        yield _count(statements)
