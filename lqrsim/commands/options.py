"""Options that several commands share."""

import ast
import inspect
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar, get_args

from tyro.conf import FlagCreatePairsOff, arg
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

import lqrsim as ls

NO_DEFAULT: Any = {"help_behavior_hint": ""}
Command = TypeVar("Command")


def optional(metavar: str, text: str | None = None) -> object:
    """An option whose help text describes its default."""
    return arg(metavar=metavar, help=text, **NO_DEFAULT)


RULES = ConstructorRegistry()


@RULES.primitive_rule
def _optional_value(info: PrimitiveTypeInfo) -> Any:
    """Read the text given for a `T | None` as a T: tyro would try None as well, and name both types if both fail."""
    kinds = set(get_args(info.type))
    if len(kinds) != 2 or NoneType not in kinds:
        return None
    (kind,) = kinds - {NoneType}
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kind, info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return spec
    return replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
    )


def options_of(file: str, name: str, /, **metavars: str | None) -> Callable[[type[Command]], type[Command]]:
    """Give a command options of a function or a record of the API, with its types, defaults and help.

    The source is parsed, for an import would take a second, for `--help` too. A command repeats the options that its
    own code reads, without help, for the type checker.

    Args:
      file: path in the package. name: the function or class, or CLASS.METHOD.
      **metavars: each option with its metavar; None for a flag, or where the type says it.
    """
    node: Any = _parsed(file)
    for part in name.split("."):
        node = next(child for child in node.body if getattr(child, "name", None) == part)
    words = ast.get_docstring(node) or ""
    types, defaults = dict[str, ast.expr](), dict[str, ast.expr]()
    if isinstance(node, ast.ClassDef):
        for entry in node.body:
            if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name) and entry.value is not None:
                types[entry.target.id], defaults[entry.target.id] = entry.annotation, entry.value
    else:
        for entry, value in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True):
            types[entry.arg], defaults[entry.arg] = entry.annotation, value

    def add(command: type[Command]) -> type[Command]:
        options = dict[str, Any]()
        for option, metavar in metavars.items():
            entry = re.search(rf"^  {option}: (.+(?:\n    .+)*)", words, re.MULTILINE)
            assert entry is not None, f"{name} does not say what {option} is"
            text = " ".join(entry[1].split())
            kind, default = _type_of(types[option], _kinds(file)), ast.literal_eval(defaults[option])
            shown = arg(metavar=metavar, help=text[0].upper() + text[1:], **{} if default is not None else NO_DEFAULT)
            options[option] = Annotated[kind, shown]
            setattr(command, option, default)
        command.__annotations__ = options | inspect.get_annotations(command) | options
        return command

    return add


def _type_of(annotation: ast.expr, kinds: Mapping[str, ast.expr]) -> Any:
    """The type that an annotation of the API says, without what `checked` asks of it besides."""

    class Bare(ast.NodeTransformer):
        def visit_Name(self, node: ast.Name) -> ast.expr:
            return self.visit(kinds[node.id]) if node.id in kinds else node

        def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
            annotated = isinstance(node.value, ast.Name) and node.value.id == "Annotated"
            if annotated and isinstance(node.slice, ast.Tuple):
                return self.visit(node.slice.elts[0])
            self.generic_visit(node)
            return node

    return eval(ast.unparse(Bare().visit(annotation)), {"Literal": Literal, "Sequence": Sequence})


@cache
def _kinds(file: str) -> dict[str, ast.expr]:
    """The annotations that have a name in a file or in `annotations.py`, such as `Positive`."""
    kinds = dict[str, ast.expr]()
    for statement in (*_parsed("annotations.py").body, *_parsed(file).body):
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            kinds[statement.targets[0].id] = statement.value
    return kinds


@cache
def _parsed(file: str) -> ast.Module:
    return ast.parse((Path(__file__).parents[1] / file).read_text(encoding="utf-8"))


ControllerName = Literal["feedback", "track", "offset_free", "replan"]
DesignSet = Annotated[
    str | None,
    optional("NAME", "Set for which track and offset_free are designed, as in `lqrsim stress`. By default moderate."),
]
SolutionFile = Annotated[
    Path | None,
    optional("FILE.npz", "Run this solution instead of solving the scenario, with its robot, horizon and goal."),
]
Folder = Annotated[Path | None, optional("FOLDER")]
Json = Annotated[FlagCreatePairsOff[bool], arg(help="Print one JSON object, all else to stderr; see docs/json.md.")]


def arguments_for(function: Callable[..., Any], command: Any, **overrides: Any) -> dict[str, Any]:
    """The options of a command that a function or a record takes, by name; `overrides` take precedence."""
    names = inspect.signature(function).parameters
    return {name: getattr(command, name) for name in names if hasattr(command, name)} | overrides


def refuse(command: Any, names: Collection[str], why: str) -> None:
    """Raise InputError if one of these options, which would be ignored, is not its default; `why` ends the message."""
    for field in fields(command):
        value = getattr(command, field.name)
        if field.name in names and value != field.default:
            got = f"{value:g}" if type(value) is float else value
            got = " ".join(map(str, value)) if isinstance(value, (tuple, list)) else got
            raise ls.InputError(f"--{field.name.replace('_', '-')}: got {got} {why}")
