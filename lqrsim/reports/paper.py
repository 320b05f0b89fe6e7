"""The page of the paper's results in Markdown, and verdicts on the paper's statements for a terminal."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

ScriptResult = dict[str, Any]  # what a script of experiments/ prints with --json

VERDICTS = {True: "holds", False: "**does not hold**", None: "not tested"}


def results_page(saved: Mapping[str, Any]) -> str:
    """All results in Markdown: verdicts on the paper's statements, what was run, and the report of each script."""
    results: dict[str, ScriptResult] = saved["results"]
    statements = [statement for one in results.values() for statement in one["statements"]]
    versions = next(iter(results.values()))["result"]["versions"]
    rows = [
        f"| {one['paper']} ({one['where']}) | {one['test']} | {one['ours']} | {VERDICTS[one['holds']]}"
        f" | [{one['figure']}](figures/{one['figure']}.png) |"
        for one in statements
    ]
    size = "a quick run, on a small part of the problems" if saved["quick"] else "a full run"
    command = "lqrsim reproduce --quick" if saved["quick"] else "lqrsim reproduce"
    parts = [
        "# The paper's results, reproduced",
        f"Written by `{command}`, {size}: every number and picture on this page is. Each section is one script of"
        " `experiments/`, which also runs by itself; the numbers query by query are in"
        " [results.json](results.json), beside this page.",
        "The paper: J. van den Berg, *Iterated LQR Smoothing for Locally-Optimal Feedback Control of Systems with"
        " Non-Linear Dynamics and Non-Quadratic Cost*, American Control Conference, 2014.",
        f"Computed with {', '.join(f'{name} {version}' for name, version in versions.items())} on {saved['machine']}.",
    ]
    if statements:
        head = "| the paper says | counts as holding | what came out | verdict | figure |"
        parts += [
            "## Which of the paper's statements hold",
            f"{_count(statements)} A statement can have several tests; what counts as holding"
            " is this project's choice.",
            "\n".join([head, "| --- " * 5 + "|", *rows]),
        ]
    for name, one in results.items():
        options = "" if not saved["quick"] else " --quick"
        parts += [one["report"], f"`python experiments/{name}.py{options}`, {one['seconds']} s."]
    return "\n\n".join(parts) + "\n"


def _count(statements: Sequence[Mapping[str, Any]]) -> str:
    """How many statements hold, in words."""
    counts = {verdict: sum(one["holds"] is verdict for one in statements) for verdict in VERDICTS}
    said = f"Of {len(statements)} tests of what the paper says, {counts[True]} hold and {counts[False]} do not"
    return f"{said}; {counts[None]} could not be tested here." if counts[None] else f"{said}."


def verdicts(results: Mapping[str, ScriptResult], out: Path) -> Iterator[str]:
    """Three lines for each statement, for a terminal."""
    statements = [statement for one in results.values() for statement in one["statements"]]
    for one in statements:
        yield f"{VERDICTS[one['holds']].strip('*').upper():<14} {one['where']}: {one['paper']}"
        yield f"{'':<14} {one['ours']}  [want: {one['test']}]"
        yield f"{'':<14} {out / 'figures' / one['figure']}.png"
    if statements:
        yield _count(statements)
