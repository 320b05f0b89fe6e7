"""Public docstrings say what names, types and defaults do not; the reference of the site is made of both."""

import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import lqrsim as ls

SECTION = re.compile(r"^(Args|Attributes|Returns|Yields|Raises):$")
MODULES = (ls.belief, ls.disturbances, ls.lq, ls.robots, ls.rotations, ls.scenarios, ls.stress, ls.types, ls.view)


def sections(doc: str) -> dict[str, list[str]]:
    """The lines of each section, without their common indentation."""
    found: dict[str, list[str]] = {}
    current = None
    for line in inspect.cleandoc(doc).splitlines():
        if match := SECTION.match(line):
            current = found.setdefault(match[1], [])
        elif line and not line.startswith(" "):
            current = None
        elif current is not None:
            current.append(line[2:])
    return found


def documented(doc: str) -> set[str]:
    """The names that have an entry of their own under Args."""
    lines = sections(doc).get("Args", [])
    return {match[1] for line in lines if (match := re.match(r"\*{0,2}(\w+): \S", line))}


def parameters(function: Callable[..., Any]) -> set[str]:
    return {name for name in inspect.signature(function).parameters if name not in ("self", "cls")}


def says_what_returns(function: Callable[..., Any], doc: str) -> bool:
    """Whether nothing is returned; or a record, which has a docstring of its own; or the summary names what it is."""
    annotation = inspect.signature(function).return_annotation
    name = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
    record = name in vars(ls.types) or name in ls.__all__ or getattr(annotation, "__module__", "").startswith("lqrsim")
    named = re.match(r"(The|A|An|Another|Whether|How|Controls|Points|df/dx) |.*[Rr]eturns its path", doc)
    return annotation in (None, "None", inspect.Signature.empty) or record or named is not None


def faults(function: Callable[..., Any], doc: str) -> list[str]:
    """Entries of arguments that there are not, and what the docstring does not say."""
    found = sorted(documented(doc) - parameters(function))
    if not sections(doc).keys() & {"Returns", "Yields"} and not says_what_returns(function, doc):
        found.append("Returns")
    if re.search(r"\bRaises InputError\b", doc):
        found.append("InputError in the text: bad input raises it everywhere, and its own reasons stand under Raises")
    return found


def functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Public functions, and those methods of public classes that have a docstring of their own and take something."""
    for module in (ls, *MODULES):
        own = getattr(module, "__all__", None) or [
            name for name, item in vars(module).items()
            if inspect.isfunction(item) and item.__module__ == module.__name__ and not name.startswith("_")
        ]  # fmt: skip
        for name in own:
            item = getattr(module, name)
            if inspect.isfunction(item):
                yield f"{module.__name__}.{name}", item
            elif inspect.isclass(item):
                for key, member in vars(item).items():
                    method = member.__func__ if isinstance(member, classmethod | staticmethod) else member
                    public = key == "__call__" or not key.startswith("_")
                    # One that overrides a method may leave the words to it.
                    inherited = any(hasattr(base, key) for base in item.__mro__[1:-1])
                    if (
                        public
                        and inspect.isfunction(method)
                        and parameters(method)
                        and (method.__doc__ or not inherited)
                    ):
                        yield f"{module.__name__}.{name}.{key}", method


def classes() -> Iterator[tuple[str, type]]:
    """Those that are made with arguments: not enumerations, nor exceptions."""
    for module in (ls, *MODULES):
        for name in getattr(module, "__all__", ()):
            item = getattr(module, name)
            if inspect.isclass(item) and not hasattr(item, "__members__") and not issubclass(item, Exception):
                yield f"{module.__name__}.{name}", item


@pytest.mark.parametrize(
    ("name", "function"), [pytest.param(*one, id=one[0]) for one in sorted(dict(functions()).items())]
)
def test_functions_and_methods_say_what_they_take_and_return(name: str, function: Callable[..., Any]) -> None:
    assert faults(function, function.__doc__ or "") == []


@pytest.mark.parametrize(("name", "item"), [pytest.param(*one, id=one[0]) for one in sorted(dict(classes()).items())])
def test_classes_describe_arguments_that_they_have(name: str, item: type) -> None:
    made: Any = item.__init__ if item.__init__ is not object.__init__ else item.__new__
    assert documented(vars(item).get("__doc__") or "") <= parameters(made)


def test_faults_are_noticed() -> None:
    def complete(a: int, **b: int) -> int:
        """A sum.

        Args:
          a: one.
          **b: others,
            see: above.

        Returns:
          Their sum.

        """
        return a

    doc = complete.__doc__ or ""
    assert faults(complete, doc) == []
    assert documented(doc) == {"a", "b"}
    assert faults(complete, doc.replace("a: one", "c: one")) == ["c"]
    bare = "Add.\n"
    assert faults(complete, bare) == ["Returns"]
    assert faults(complete, bare.replace("Add", "A sum")) == []
    (told,) = faults(complete, f"{doc}\n\nRaises InputError.")
    assert told.startswith("InputError in the text")
