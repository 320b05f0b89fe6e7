"""What one can take in at once: functions, and what they are called with; and test files that stand alone."""

import ast
from collections.abc import Iterator
from pathlib import Path

import lqrsim

PACKAGE = Path(lqrsim.__file__).parent
TESTS = Path(__file__).parent

LINES_OF_A_FUNCTION = 90
POSITIONAL_ARGUMENTS = 8


def files() -> Iterator[tuple[str, str]]:
    """The name of each module, as in `solvers/ilqr.py`, and its text."""
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path.relative_to(PACKAGE).as_posix(), path.read_text(encoding="utf-8")


def functions(tree: ast.AST, prefix: str) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef, bool]]:
    """Every function at any depth, by its qualified name, and whether it is given an instance or a class first."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            static = any(ast.unparse(decorator) == "staticmethod" for decorator in node.decorator_list)
            yield f"{prefix}{node.name}", node, isinstance(tree, ast.ClassDef) and not static
            yield from functions(node, f"{prefix}{node.name}.")
        else:
            inner = f"{prefix}{node.name}." if isinstance(node, ast.ClassDef) else prefix
            yield from functions(node, inner)


def long_functions(name: str, text: str) -> set[str]:
    """Those of too many lines, from `def` to the end, the docstring included."""
    return {
        qualified
        for qualified, node, _ in functions(ast.parse(text), f"{name}: ")
        if (node.end_lineno or 0) - node.lineno + 1 > LINES_OF_A_FUNCTION
    }


def many_arguments(name: str, text: str) -> set[str]:
    """Those with too many arguments that may be given by place; `self` and `cls` do not count."""
    return {
        qualified
        for qualified, node, bound in functions(ast.parse(text), f"{name}: ")
        if len(node.args.posonlyargs) + len(node.args.args) - bound > POSITIONAL_ARGUMENTS
    }


def test_functions_are_short() -> None:
    assert {found for name, text in files() for found in long_functions(name, text)} == set()


def test_functions_take_few_arguments_by_place() -> None:
    assert {found for name, text in files() for found in many_arguments(name, text)} == set()


def test_what_is_over_a_limit_is_noticed() -> None:
    """In a class, in a function, under an `if`; exactly at the limit nothing is said."""
    at, over = ("\n".join(["    pass"] * count) for count in (LINES_OF_A_FUNCTION - 1, LINES_OF_A_FUNCTION))
    assert long_functions("a.py", f"def f():\n{at}") == set()
    assert long_functions("a.py", f"if True:\n  def f():\n{over}") == {"a.py: f"}
    most = ", ".join(f"a{i}" for i in range(POSITIONAL_ARGUMENTS))
    assert many_arguments("a.py", f"def f({most}, *, k, l): pass") == set()
    assert many_arguments("a.py", f"def f({most}, /, b): pass") == {"a.py: f"}
    assert many_arguments("a.py", f"class C:\n  def f(self, {most}): pass") == set()
    assert many_arguments("a.py", f"class C:\n  @staticmethod\n  def f(x, {most}): pass") == {"a.py: C.f"}
    assert many_arguments("a.py", f"def g():\n  def f(x, {most}): pass") == {"a.py: g.f"}


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
