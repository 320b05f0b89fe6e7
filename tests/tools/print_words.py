"""Prints all sentences of the package that a user may read, by kind and place, so that a person can read them through.

Kinds: `status` (meanings and remedies), `solve` (summaries of those of tests/helpers/failing_solves.py),
`warning`, `error`, `say` (details, summaries, progress, figures), `help`.
Values that are filled in are shown as `{}`.
"""

import argparse
import ast
import contextlib
import io
import sys
from collections.abc import Iterator
from pathlib import Path

import lqrsim
from lqrsim import cli
from lqrsim.commands import COMMANDS

PACKAGE, TESTS = Path(lqrsim.__file__).parent, Path(__file__).parents[1]
KINDS = ("status", "solve", "warning", "error", "say", "help")
CODE = ("kernels", "codegen")  # rooms with programs as texts, of which only errors and warnings are read by users


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"some of {', '.join(KINDS)}; by default all")
    kinds = parser.parse_args().kinds or KINDS
    if unknown := set(kinds) - set(KINDS):
        parser.error(f"got {', '.join(sorted(unknown))}, want some of {', '.join(KINDS)}")
    found: dict[str, list[str]] = {kind: [] for kind in KINDS}
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE)
        for kind, line, text in sentences(ast.parse(path.read_text(encoding="utf-8"))):
            if kind != "say" or place.parts[0] not in CODE:
                found[kind].append(f"{place}:{line}: {text}")
    found["status"] += [f"{one.name}: {one.meaning} | {one.remedy}" for one in lqrsim.Status]
    if "help" in kinds:
        found["help"] += helps()
    if "solve" in kinds:
        found["solve"] += solves()
    for kind in kinds:
        print(f"== {kind}", *found[kind], "", sep="\n")
    return 0


def sentences(tree: ast.Module) -> Iterator[tuple[str, int, str]]:
    """The kind, line and words of each text of at least two words in a module that is no docstring."""
    parent = {below: node for node in ast.walk(tree) for below in ast.iter_child_nodes(node)}
    for node in ast.walk(tree):
        if not isinstance(node, ast.JoinedStr | ast.Constant) or isinstance(parent[node], ast.JoinedStr | ast.Expr):
            continue
        text = words(node)
        if len(text.replace("{}", "").split()) < 2:
            continue
        above: list[ast.AST] = [node]
        while above[-1] in parent:
            above.append(parent[above[-1]])
        kind = "say"
        if any(isinstance(one, ast.Raise) for one in above):
            kind = "error"
        elif any(isinstance(one, ast.Call) and ast.unparse(one.func).endswith(("warning", "warn")) for one in above):
            kind = "warning"
        yield kind, node.lineno, text


def words(node: ast.JoinedStr | ast.Constant) -> str:
    """A text on one line, with {} for what is filled in; empty for a constant that is no text."""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    shown = [one.value if isinstance(one, ast.Constant) else "{}" for one in parts]
    return " ".join("".join(one for one in shown if isinstance(one, str)).split())


def helps() -> list[str]:
    """The help of `lqrsim` and of each of its commands, as it is printed."""
    found = []
    for command in ("", *COMMANDS):
        with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
            cli.main([*command.split(), "--help"])
        found.append(said.getvalue())
    return found


def solves() -> list[str]:
    """What is printed of solves that fail, each with its name."""
    sys.path[:0] = [str(TESTS), str(TESTS / "helpers")]
    from failing_solves import CASES

    return [f"{name}:\n{case.solver(case.of, **case.options)}\n" for name, case in CASES.items()]


if __name__ == "__main__":
    sys.exit(main())
