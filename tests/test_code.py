"""Test files stand alone."""

import ast
from pathlib import Path

TESTS = Path(__file__).parent


def test_no_test_file_imports_another() -> None:
    """What several of them need is in tests/helpers/, the only folder of tests/ from which they can import."""
    names = {path.stem for path in TESTS.glob("*.py")}
    for path in TESTS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            imported += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            for module in imported:
                first, *rest = module.split(".")
                assert first not in names, f"{path.name} imports {module}"
                assert first != "tests", f"{path.name} imports {module}"
                assert not rest or rest[-1] not in names, f"{path.name} imports {module}"
