"""Faults seeded into the package, one at a time, and which of them tests find.

    python tests/tools/seed_faults.py lqrsim/stress/statistics.py --tests tests/test_statistics.py --count 20

Each is one operator, comparison or number of a copy that is another, such as `<=` for `<`. What no test finds may
still be no fault: a tolerance, or a line that no result depends on.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

OTHER = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "+": "-", "-": "+", "*": "/", "/": "*"}
OTHER |= {"and": "or", "or": "and", "@": "*", "is": "is not", "is not": "is", "in": "not in", "not in": "in"}
ROOT = Path(__file__).parents[2]


def faults(text: str) -> Iterator[tuple[int, int, str]]:
    """From where to where in the text, and what stands there instead."""
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))

    def place(node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    encoded, tree = text.encode(), ast.parse(text)
    # Python 3.11 knows no places within an f-string.
    inside = {each for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for each in ast.walk(node)}
    for node in ast.walk(tree):
        if node in inside:
            continue
        between: list[tuple[ast.expr, ast.expr]] = []
        if isinstance(node, ast.BinOp):
            between = [(node.left, node.right)]
        elif isinstance(node, ast.BoolOp):
            between = [*zip(node.values, node.values[1:], strict=False)]
        elif isinstance(node, ast.Compare):
            between = [*zip([node.left, *node.comparators], node.comparators, strict=False)]
        elif (
            isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)
        ):
            yield *place(node), repr(1.1 * node.value or 0.1 if isinstance(node.value, float) else node.value + 1)
        for left, right in between:
            first, last = place(left)[1], place(right)[0]
            written = encoded[first:last].decode()
            word = written.strip(" ()\n")
            if word in OTHER:
                yield first, last, written.replace(word, OTHER[word])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", help="files of the package in which faults are seeded")
    parser.add_argument("--tests", nargs="+", required=True, help="arguments of pytest")
    parser.add_argument("--count", type=int, default=20, help="faults in each file")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "runs", "videos", "__pycache__"))
        environment = os.environ | {"PYTHONPATH": str(copy)}
        test = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not long", "-p", "no:cacheprovider", *asked.tests]

        def fails() -> bool:
            try:
                return subprocess.run(test, cwd=copy, env=environment, capture_output=True, timeout=900).returncode != 0
            except subprocess.TimeoutExpired:
                return True

        if fails():
            sys.exit("the tests fail without a fault")
        for name in asked.files:
            text = (copy / name).read_text(encoding="utf-8")
            known = sorted(faults(text))
            for first, last, instead in random.Random(asked.seed).sample(known, min(asked.count, len(known))):
                spoilt = text.encode()[:first] + instead.encode() + text.encode()[last:]
                (copy / name).write_bytes(spoilt)
                found = fails()
                missed += not found
                line, said = text.encode()[:first].count(b"\n"), "found " if found else "missed"
                print(said, f"{name}:{line + 1}:", spoilt.decode().splitlines()[line].strip(), flush=True)
            (copy / name).write_text(text, encoding="utf-8")
    print(f"{missed} missed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
