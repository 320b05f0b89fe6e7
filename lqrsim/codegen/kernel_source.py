"""The text of the modules in the numba subset, with what they leave open filled in.

Such a module declares at its top what depends on the problem (`AXES = (0, 1, 2)`, which states are the position), so
that it can be read, linted and type-checked as it stands. `source_of` puts in what it is for one problem.
"""

import ast
import functools
import importlib
import inspect
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from lqrsim.errors import InputError, check_kind, excerpt


def source_of(module: ModuleType, *functions: str, **constants: Any) -> str:
    """The text of a module's functions that are in the numba subset.

    Args:
      functions: names of those that are wanted; by default those below the line that says so, or all.
      constants: the numbers and tuples of numbers to put in for names that the module declares.

    Raises:
      AttributeError: the module has no such function, or declares no such constant.
    """
    return _source(module.__name__, functions, tuple(constants.items()))


@functools.lru_cache(maxsize=256)  # a problem that is stated again and again has the same sources
def _source(name: str, functions: tuple[str, ...], pairs: tuple[tuple[str, Any], ...]) -> str:
    """See `source_of`; of the module of that name."""
    module, constants = importlib.import_module(name), dict(pairs)
    for wanted in (*functions, *constants):
        getattr(module, wanted)
    source = inspect.getsource(module)
    marks = [i for i, line in enumerate(source.splitlines(), start=1) if line.startswith("# The numba subset")]
    nodes = [node for node in ast.parse(source).body if isinstance(node, ast.FunctionDef)]
    nodes = [node for node in nodes if node.lineno > (marks[0] if marks else 0)]
    nodes = [node for node in nodes if not functions or node.name in functions]
    if constants:
        nodes = [_Fill(constants).visit(node) for node in nodes]
    return "\n\n".join(ast.unparse(node) for node in nodes)


def check_source(field: str, source: object, functions: Mapping[str, int]) -> None:
    """Raises InputError unless it is source text that defines these functions, of so many arguments, and can compile.

    What there is besides Python's own arithmetic is named without its module: cos, not math.cos or np.cos.
    """
    wanted = " and ".join(f"{name}(...)" for name in functions)
    check_kind(f"{field}: source", source, str, f"text that defines {wanted}")
    wrong = _wrong(str(source), tuple(functions.items()))
    if wrong:
        raise InputError(f"{field}: source: {wrong}")


@functools.lru_cache(maxsize=256)  # a problem that is stated again and again has the same sources
def _wrong(source: str, functions: tuple[tuple[str, int], ...]) -> str:
    """What is wrong with a source; see `check_source`."""
    try:
        tree = ast.parse(source)
    except Exception as error:  # SyntaxError, or what nesting, null characters and the like lead to
        return f"got {excerpt(source)}, which is no Python ({error}), want functions"
    defined = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    for name, count in functions:
        found = defined.get(name)
        if found is None:
            return f"got {excerpt(source)}, want it to define {name}(...)"
        if len(found.args.args) != count:
            return f"got {name} of {len(found.args.args)} arguments, want {count}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            return f"got an import in line {node.lineno}, want none: sqrt, exp, cos and the like are at hand"
        if isinstance(node, ast.Attribute):
            return f"got {ast.unparse(node)} in line {node.lineno}, want {node.attr}: modules are not at hand"
    return ""


class _Fill(ast.NodeTransformer):
    """Puts constants in, and works out what depends on them alone: lengths, entries, and which branch is taken.

    An entry that a tuple does not have is no error in a branch that is not taken, as it would be for numba.
    """

    def __init__(self, constants: dict[str, Any]) -> None:
        self.constants = constants

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Constant(self.constants[node.id]) if node.id in self.constants else node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        match node:
            case ast.Call(func=ast.Name("len"), args=[ast.Constant(value)]):
                sized: Any = value  # a tuple's, which ast does not know of
                return ast.Constant(len(sized))
        return node

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        self.generic_visit(node)
        match node:
            case ast.Subscript(value=ast.Constant(value), slice=ast.Constant(int(index))):
                indexed: Any = value
                return ast.Constant(indexed[index])
        return node

    def visit_IfExp(self, node: ast.IfExp) -> ast.AST:
        test = self.visit(node.test)
        if any(isinstance(inner, ast.Name) for inner in ast.walk(test)):
            return self.generic_visit(node)
        expression = ast.fix_missing_locations(ast.Expression(test))
        return self.visit(node.body if eval(compile(expression, "<constant>", "eval")) else node.orelse)
