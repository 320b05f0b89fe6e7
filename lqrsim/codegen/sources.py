"""Functions in the kernels' subset, and the meaning of the names in them.

A `Source` is a module or a text. A module of `lqrsim/kernels` is all kernels; that of a cost or constraint has its
kernels beside its class. Open names are filled in: constants, such as the indices of the position, and functions, such
as the centres of balls. No text is joined or renamed: a `Scope` resolves the names in a source, for the printer to LLVM
IR (`printer.py`) and for plain Python (`plain.py`).
"""

import ast
import functools
import importlib
import inspect
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from lqrsim import kernels
from lqrsim.annotations import checked
from lqrsim.codegen.language import CONSTANTS, MATH, SubsetError
from lqrsim.errors import InputError, check_kind, excerpt
from lqrsim.kernels import declarations, distances, linear_algebra, records, rotation_ratios
from lqrsim.results.archive import sha256

# Words of the language that `declarations.py` declares.
WORDS = (
    "stack", "zeros", "call", "call_for_value", "at", "rows_at", "int32", "claim", "load", "store", "fetch_add",
    "power_of_two", "inline", "outline", "compact", "exact",
)  # fmt: skip
PYTHON = ("range", "len", "abs", "min", "max", "int", "float")

Constant = bool | int | float | tuple[Any, ...]


@checked
@dataclass(frozen=True)
class Source:
    """Functions of a module or a text; `source_of` and `text_source` make it.

    Attributes:
      text: of a user's module, as it was loaded: it may be edited, and loaded again. Of the package's modules empty.
      constants: (name, number or tuple of numbers), which replace the module's. Of a user's module, which may change
        them, all that its functions name.
      fills: (name, source, name there) of functions that take the place of functions of the module or its imports.
    """

    module: str = ""
    text: str = ""
    constants: tuple[tuple[str, Constant], ...] = ()
    fills: tuple[tuple[str, "Source", str], ...] = ()
    what: str = field(default="source", compare=False)

    def __hash__(self) -> int:
        return self._hash

    @functools.cached_property
    def _hash(self) -> int:
        return hash((self.module, self.text, self.constants, self.fills))

    @functools.cached_property
    def digest(self) -> str:
        """A hash of everything that defines the source."""
        filled = (f"{name}={source.digest}.{inner_name}" for name, source, inner_name in self.fills)
        text = self.text or _text_of(self.module)
        if self.module and self.text:  # what else stands in a user's file changes no compiled code
            text = "\n".join(map(ast.unparse, _parse(text).functions.values()))
        return sha256(self.module, text, repr(self.constants), *filled)

    def filled(self, **fills: "Source | tuple[Source, str]") -> "Source":
        """This source with functions filled in: name -> source, or (source, name there).

        A function can be filled in if the module defines it, or if the module, or one that it imports from, imports it
        from `declarations.py`, where it is empty: there stands which files have the real one.
        """
        kept = (fill for fill in self.fills if fill[0] not in fills)
        new = ((name, *fill) if isinstance(fill, tuple) else (name, fill, name) for name, fill in fills.items())
        return Source(self.module, self.text, self.constants, (*kept, *new), self.what)

    def has(self, name: str) -> bool:
        """Whether there is a function of that name, the source's own or filled in."""
        return isinstance(Scope(self, {}).find(name), ScopedFunction)


def source_of(module: ModuleType | str, **constants: Constant) -> Source:
    """The kernels of a module: its functions in the subset of Python that `codegen/language.py` defines.

    They may use what they import from `math` and `lqrsim.kernels`, and the module's numbers and tuples of numbers.

    Args:
      module: `__name__`, in the file of a cost or constraint; or a module.
      **constants: numbers and tuples of numbers, in place of the module's.
    """
    check_kind("source_of: module", module, (str, ModuleType), "__name__, in the file of a cost or constraint")
    name = module if isinstance(module, str) else module.__name__
    home = sys.modules.get(name)
    if not getattr(home, "__file__", None):
        raise InputError(f"source_of: module: got {excerpt(module)}, want a file that was imported; or a text for it")
    for constant, number in constants.items():
        if not (_is_constant(getattr(home, constant, None)) and _is_constant(number)):
            want = "a number or a tuple of numbers, in place of one that the file declares"
            raise InputError(f"source_of: {constant}: got {excerpt(number)}, want {want}")
    if name.startswith(__name__.partition(".")[0] + "."):  # a module of the package does not change
        return Source(name, constants=tuple(sorted(constants.items())), what=name)
    parsed, used = _parse(_text_of(name)), dict[str, Constant]()
    for node in (node for function in parsed.functions.values() for node in ast.walk(function)):
        if isinstance(node, ast.Name) and node.id not in parsed.imports and _is_constant(getattr(home, node.id, None)):
            used[node.id] = getattr(home, node.id)
    return Source(name, _text_of(name), tuple(sorted((used | constants).items())), what=name)


def text_source(text: str, what: str = "source") -> Source:
    """The functions that a text defines: a traced formula, or a user's own."""
    return Source(text=text, what=what)


def check_source(field: str, source: object, functions: Mapping[str, int]) -> Source:
    """The Source of a text, which must define these functions of that many arguments; a Source is returned as it is."""
    if isinstance(source, Source):
        return source
    what = f"{field}: source"
    text = check_kind(what, source, str, f"text that defines {' and '.join(f'{name}(...)' for name in functions)}")
    if wrong := _wrong(text, tuple(functions.items())):
        raise InputError(f"{what}: {wrong}")
    return text_source(text, what)


@functools.lru_cache(maxsize=256)  # a problem that is stated repeatedly has the same sources
def _wrong(source: str, functions: tuple[tuple[str, int], ...]) -> str:
    """A message that says what is wrong with a text; empty if the text is valid."""
    try:
        tree = ast.parse(source)
    except Exception as error:  # SyntaxError, or other exceptions, as for deep nesting or null characters
        return f"got {excerpt(source)}, which is not valid Python ({error}), want function definitions"
    defined = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    for name, count in functions:
        definition = defined.get(name)
        if definition is None:
            return f"got {excerpt(source)}, which does not define {name}(...), want it to"
        if len(definition.args.args) != count:
            return f"got {name}(...) with {len(definition.args.args)} arguments, want {count}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            return f"got an import in line {node.lineno}, want none: sqrt, exp, cos and the like need none"
        if isinstance(node, ast.Attribute):
            return f"got {ast.unparse(node)} in line {node.lineno}, want {node.attr}, without a module"
    return ""


@dataclass(frozen=True)
class ScopedFunction:
    """A function, and the scope that resolves its names."""

    scope: "Scope"
    node: ast.FunctionDef

    @property
    def decorators(self) -> set[str]:
        """The names of the decorators; without any, in a file of kernels that is COMPACT, `compact`."""
        stated = {decorator.id for decorator in self.node.decorator_list if isinstance(decorator, ast.Name)}
        compact = not stated and _is_kernels(self.scope.source.module) and self.scope.find("COMPACT")
        return {"compact"} if compact else stated


@dataclass(frozen=True)
class Word:
    """A word of the language, from `declarations.py`, `math` or Python."""

    name: str


@dataclass(frozen=True)
class Record:
    """A named tuple of `kernels/records.py`."""

    name: str
    fields: tuple[str, ...]


Meaning = ScopedFunction | Word | Record | Constant


@dataclass(frozen=True)
class _Parsed:
    """A parsed module or text."""

    functions: dict[str, ast.FunctionDef]
    imports: dict[str, tuple[str, str]]  # name here -> module, name there


class Scope:
    """The meaning of each name in a source, for one set of the sizes in `declarations.py`: N, M, ...; W is N + M."""

    def __init__(self, source: Source, sizes: Mapping[str, int]) -> None:
        self.source, self.sizes = source, {"W": sizes.get("N", 0) + sizes.get("M", 0), **sizes}
        parsed = _parse(source.text or _text_of(source.module))
        self._functions, self._imports = parsed.functions, parsed.imports
        self._constants = dict(source.constants)
        self._fills = {name: (filled, inner_name) for name, filled, inner_name in source.fills}
        self._scopes: dict[Source, Scope] = {}
        self._found: dict[str, Meaning | None] = {}

    def find(self, name: str) -> Meaning | None:
        """The meaning of a name; None if it is not defined."""
        if name not in self._found:
            self._found[name] = self._find(name)
        return self._found[name]

    def function(self, name: str) -> ScopedFunction:
        meaning = self.find(name)
        if not isinstance(meaning, ScopedFunction):
            raise SubsetError(f"{self.source.what}: got no function {name}, want it defined")
        return meaning

    def _find(self, name: str) -> Meaning | None:
        if name in self._constants:
            return self._constants[name]
        if name in self._fills:
            return self._filled(name)
        if name in self._functions:
            return ScopedFunction(self, self._functions[name])
        if name in self._imports:
            return self._imported(*self._imports[name])
        if self.source.module:
            value = getattr(_imported(self.source.module), name, None)
            if _is_constant(value):
                return value
        elif (meaning := self._at_hand(name)) is not None:
            return meaning
        return Word(name) if name in PYTHON else None

    def _imported(self, module: str, name: str) -> Meaning | None:
        if module == "math":
            return getattr(math, name) if name in CONSTANTS else Word(name) if name in MATH else None
        if module == declarations.__name__:
            return self._declared(name)
        if module == records.__name__:
            kind = getattr(records, name, None)
            return Record(name, kind._fields) if isinstance(kind, type) and hasattr(kind, "_fields") else None
        return self._module(module).find(name) if _is_kernels(module) else None

    def _declared(self, name: str) -> Meaning | None:
        """The meaning of a name in `declarations.py`: a size, a word, a filled-in function, or a constant."""
        if name in self.sizes:
            return self.sizes[name]
        if name in WORDS:
            return Word(name)
        if name in self._fills:
            return self._filled(name)
        value = getattr(declarations, name, None)
        return value if _is_constant(value) else None

    def _filled(self, name: str) -> ScopedFunction:
        source, inner_name = self._fills[name]
        return self._scope_of(source).function(inner_name)

    def _at_hand(self, name: str) -> Meaning | None:
        """The meaning of a name that a text can use without importing it."""
        if name in MATH:
            return self._imported("math", name)
        for module in (rotation_ratios, distances, linear_algebra):
            if name in _parse(_text_of(module.__name__)).functions:
                return self._module(module.__name__).find(name)
        return self._declared(name)

    def _module(self, module: str) -> "Scope":
        """The scope of another kernel module, with this source's fills for the names that the module leaves open."""
        fills = tuple(fill for fill in self.source.fills if fill[0] in _left_open(module))
        return self._scope_of(Source(module, fills=fills, what=module))

    def _scope_of(self, source: Source) -> "Scope":
        if source not in self._scopes:
            scope = Scope(source, self.sizes)
            scope._scopes = self._scopes  # one scope per source in a program
            self._scopes[source] = scope
        return self._scopes[source]


def _is_constant(value: object) -> bool:
    if isinstance(value, tuple):
        return all(_is_constant(entry) for entry in value)
    return isinstance(value, bool | int | float)


def _is_kernels(module: str) -> bool:
    return module.startswith(f"{kernels.__name__}.")


def _imported(module: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except (ImportError, ValueError, RecursionError):  # the last for a name of a thousand parts
        raise InputError(f"source: module: got {excerpt(module)}, want the name of one that can be imported") from None


_texts: dict[str, tuple[Any, str]] = {}  # of modules, beside the specification with which each was loaded


def _text_of(module: str) -> str:
    """The text of a module when it was last loaded, as far as it was read before an edit."""
    spec = _imported(module).__spec__
    if module not in _texts or _texts[module][0] is not spec:
        _texts[module] = spec, inspect.getsource(_imported(module))
    return _texts[module][1]


@functools.cache
def _left_open(module: str) -> frozenset[str]:
    """The names that can be filled in for a module: its functions, and the declarations that it and its imports use."""
    parsed = _parse(_text_of(module))
    declared = {name for home, name in parsed.imports.values() if home == declarations.__name__}
    others = {home for home, _ in parsed.imports.values() if _is_kernels(home) and home not in _WITHOUT_FUNCTIONS}
    return frozenset(declared | parsed.functions.keys()).union(*(_left_open(home) for home in others))


_WITHOUT_FUNCTIONS = (declarations.__name__, records.__name__)


@functools.lru_cache(maxsize=512)
def _parse(text: str) -> _Parsed:
    functions, imports = {}, {}
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:  # as for deep nesting or null characters
        raise SubsetError(f"got {excerpt(text)}, which is not valid Python ({error}), want functions") from None
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            functions[node.name] = node
        elif isinstance(node, ast.ImportFrom):
            imports |= {alias.asname or alias.name: (str(node.module), alias.name) for alias in node.names}
    return _Parsed(functions, imports)
