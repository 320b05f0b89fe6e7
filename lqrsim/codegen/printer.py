"""Print kernels as LLVM IR; `language.py` defines their subset of Python.

A function is printed once for each combination of argument types. Records and tuples are passed as their parts, so that
LLVM sees numbers and addresses; variables are slots on the stack, which LLVM turns into registers. Functions that are
`compact` take records by address instead, with 8 bytes for each part: calls with hundreds of arguments take long to
compile.
"""

import ast
import functools
import itertools
import math
import operator
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn, TypeGuard

from lqrsim.codegen.language import (
    BINARY,
    BOOL,
    FLOAT,
    INT,
    INT32,
    SCALES,
    TESTS,
    UNARY,
    VECTOR,
    Group,
    Pointer,
    Pointers,
    Scalar,
    SubsetError,
    Type,
    describe,
    join,
    llvm_type,
    scalars,
)
from lqrsim.codegen.sources import Constant, Record, Scope, ScopedFunction, Word

FAST = "reassoc nsz arcp contract"  # lets LLVM fuse and reorder sums, but keeps NaN and infinity meaningful
MOST_FACTORS = 64  # largest constant exponent of a power that becomes a product
MOST_ON_STACK = 1 << 20  # largest count of numbers in a work array: 8 MiB, the whole stack of a thread

_COMPARISONS = {
    ast.Lt: ("lt", operator.lt), ast.LtE: ("le", operator.le), ast.Gt: ("gt", operator.gt),
    ast.GtE: ("ge", operator.ge), ast.Eq: ("eq", operator.eq), ast.NotEq: ("ne", operator.ne),
}  # fmt: skip
# Numbers of arguments of words that do not take one argument; the numbers of `_MANY` are the least.
_COUNTS = {
    "min": 2, "max": 2, "rows_at": 2, "claim": 2, "load": 2, "store": 3, "fetch_add": 3, "stack": 1, "zeros": 1,
}  # fmt: skip
_MANY = ("min", "max", "stack", "zeros", "call", "call_for_value")
_OPERATORS: dict[type[ast.operator], tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("add", operator.add), ast.Sub: ("sub", operator.sub), ast.Mult: ("mul", operator.mul),
    ast.Div: ("div", operator.truediv), ast.FloorDiv: ("floordiv", operator.floordiv),
    ast.Mod: ("mod", operator.mod), ast.Pow: ("pow", operator.pow),
}  # fmt: skip


@dataclass(frozen=True)
class Value:
    """The value of an expression: its type, its name in LLVM or its parts, and its number if constant."""

    type: Type
    name: str = ""
    parts: tuple["Value", ...] = ()
    constant: Constant | None = None


@dataclass(frozen=True)
class Address:
    """Where a record is in memory, with 8 bytes for each of its parts: a pointer, or a slot that holds it."""

    name: str
    in_slot: bool = False


@dataclass
class Block:
    """A basic block."""

    label: str
    lines: list[str]
    ended: bool = False


class _Retyped(Exception):
    """The exception for a variable or result that turned out to be a float: the function must be printed again."""


class Program:
    """The LLVM IR of kernels and everything that they call. `export` and `entry` add functions; `text` is the IR."""

    def __init__(self) -> None:
        self._instances: dict[tuple[Any, ...], tuple[str, Type | None]] = {}
        self._running: list[tuple[Any, ...]] = []
        self._texts: list[str] = []
        self._declared: dict[str, str] = {}

    @property
    def text(self) -> str:
        kinds = "attributes #0 = { nounwind }\nattributes #1 = { nounwind alwaysinline }\n"
        kinds += "attributes #2 = { nounwind noinline }\nattributes #3 = { nounwind noinline optsize }\n"
        return "\n".join([*self._declared.values(), *self._texts, kinds])

    def instance(self, function: ScopedFunction, types: tuple[Type, ...]) -> tuple[str, Type | None]:
        """LLVM's name of a function for arguments of these types, and the type of its result."""
        key, result = (id(function.scope), function.node.name, types), None
        if key not in self._instances:
            if any(running[:2] == key[:2] for running in self._running):
                raise SubsetError(f"{where(function, function.node)}: got a function that calls itself, want a loop")
            self._running.append(key)
            plain = function.node.name if function.node.name.isascii() else "function"
            name = f"@{plain}.{len(self._instances) + len(self._running)}"  # unique: the number of functions begun
            widened, body = dict[str, Type](), None
            while body is None:
                body = _Body(self, function, types, widened, result)
                try:
                    body.run()
                except _Retyped:
                    result, body = body.result, None
                except RecursionError:
                    place = where(function, function.node)
                    raise SubsetError(f"{place}: got expressions nested too deeply, want less nesting") from None
            self._running.pop()
            self._texts.append(body.text(name))
            self._instances[key] = name, body.result
        return self._instances[key]

    def declare(self, name: str, returns: str, arguments: str) -> str:
        """Declare a function with LLVM's types; return LLVM's name of it."""
        self._declared.setdefault(name, f"declare {returns} @{name}({arguments}) #0")
        return f"@{name}"

    def export(self, function: ScopedFunction, types: tuple[Type, ...], symbol: str) -> None:
        """Add a C function of that name; records are passed as their parts.

        A whole number that it returns becomes a float, such as the value of a formula that is 0: callers take a float.
        """
        parameters = [f"{llvm_type(kind)} %a{i}" for i, kind in enumerate(_passed(function, types))]
        kind, call, result = self._call_of(function, types)
        body = [f"  {call}", "  ret void"] if kind == "void" else [f"  %r = {call}", f"  ret {kind} %r"]
        if result is INT or result is BOOL:
            convert, integer, kind = "sitofp" if result is INT else "uitofp", kind, "double"
            body = [f"  %n = {call}", f"  %r = {convert} {integer} %n to double", "  ret double %r"]
        self._texts.append("\n".join([f"define {kind} @{symbol}({', '.join(parameters)}) #0 {{", *body, "}"]))

    def entry(self, function: ScopedFunction, types: tuple[Type, ...], symbol: str) -> list[Scalar]:
        """Add a C function of one address, at which there are 8 bytes for each number and address of the arguments.

        It writes the numbers that it returns after them. Returns the types of these numbers.
        """
        kind, call, result = self._call_of(function, types)
        parts = scalars(result) if result is not None else []
        returned = [part for part in parts if isinstance(part, Scalar) and part is not INT32]
        if len(returned) < len(parts):
            raise SubsetError(f"{where(function, function.node)}: got {describe(result)} returned, want numbers")
        lines, place = [], 0
        for i, member in enumerate(_passed(function, types)):
            name = "a" if isinstance(member, Group) else "p"
            lines.append(f"  %{name}{i} = getelementptr inbounds i64, ptr %words, i64 {place}")
            if member is BOOL:
                lines += [f"  %w{i} = load i64, ptr %p{i}", f"  %a{i} = trunc i64 %w{i} to i1"]
            elif not isinstance(member, Group):
                lines.append(f"  %a{i} = load {llvm_type(member)}, ptr %p{i}")
            place += len(scalars(member))
        lines.append(f"  {call}" if result is None else f"  %r = {call}")
        for i, member in enumerate(returned):
            part, stored = "%r", llvm_type(member)
            if isinstance(result, Group):
                lines.append(f"  %o{i} = extractvalue {kind} %r, {i}")
                part = f"%o{i}"
            if member is BOOL:
                lines.append(f"  %z{i} = zext i1 {part} to i64")
                part, stored = f"%z{i}", "i64"
            lines.append(f"  %q{i} = getelementptr inbounds i64, ptr %words, i64 {place + i}")
            lines.append(f"  store {stored} {part}, ptr %q{i}")
        self._texts.append("\n".join([f"define void @{symbol}(ptr %words) #0 {{", *lines, "  ret void", "}"]))
        return returned

    def _call_of(self, function: ScopedFunction, types: tuple[Type, ...]) -> tuple[str, str, Type | None]:
        """LLVM's type of a function's result, a call with the arguments %a0, %a1, ..., and the type of the result."""
        name, result = self.instance(function, types)
        kind = "void" if result is None else llvm_type(result)
        arguments = ", ".join(f"{_passed_type(each)} %a{i}" for i, each in enumerate(_passed(function, types)))
        return kind, f"call {kind} {name}({arguments})", result


def where(function: ScopedFunction, node: ast.AST) -> str:
    """The position of a node, for messages."""
    return f"{function.scope.source.what}: {function.node.name}, line {getattr(node, 'lineno', 0)}"


class _Body:
    """One function, printed for arguments of certain types.

    Args:
      widened: names that turned out to be floats, with their types. result: type of the result, as far as known.
    """

    def __init__(
        self, program: Program, function: ScopedFunction, types: tuple[Type, ...], widened: dict[str, Type],
        result: Type | None,
    ) -> None:  # fmt: skip
        self.program, self.function, self.widened, self.result = program, function, widened, result
        self.scope: Scope = function.scope
        self.types = types
        self._count = 0
        self._slots: list[str] = []
        self._names: dict[str, tuple[Type, Any]] = {}
        self._loops: list[tuple[str, str]] = []
        self._left: set[str] = set()  # ends of loops that a break reaches
        self._own: set[str] = set()  # variables that may be or hold work arrays of this function
        self._constants: dict[str, Value] = {}  # arguments that keep their values
        names = (name for name in ast.walk(function.node) if isinstance(name, ast.Name))
        self._stores = Counter(name.id for name in names if isinstance(name.ctx, ast.Store))
        self._local = {*self._stores, *(argument.arg for argument in function.node.args.args)}
        self._now = Block("body", [])  # the block that is printed
        self._blocks = [self._now]
        self._fast = "contract" if "exact" in function.decorators else FAST
        self._empty = False  # whether some path returns nothing

    # Lines and blocks.

    def run(self) -> None:
        arguments, decorators = self.function.node.args, self.function.node.decorator_list
        if len(self.function.decorators & {"inline", "outline", "compact", "exact"}) < len(decorators):
            got, want = f"`@{ast.unparse(decorators[0])}`", "@inline, @outline, @compact, @exact or none"
            self._refuse(self.function.node, got, want)
        if arguments.vararg or arguments.kwarg or arguments.kwonlyargs or arguments.defaults or arguments.posonlyargs:
            self._refuse(self.function.node, "arguments with defaults, * or **", "positional ones")
        if len(arguments.args) != len(self.types):
            self._refuse(self.function.node, f"{len(self.types)} arguments", str(len(arguments.args)))
        names = (f"%a{i}" for i in itertools.count())
        for argument, kind in zip(arguments.args, self.types, strict=True):
            record = (kind, Address(next(names))) if isinstance(kind, Group) and _by_address(self.function) else None
            if argument.arg in self._stores:
                self._store(argument.arg, self._get(*record) if record else _assemble(kind, names), argument)
            elif record:
                self._names[argument.arg] = record
            else:
                self._constants[argument.arg] = _assemble(kind, names)
        self._block(self.function.node.body)
        if not self._now.ended:
            if self.result is not None:
                self._refuse(self.function.node, "a path that returns nothing", "a value on all")
            self._end("ret void")
        elif self._empty and self.result is not None:
            self._refuse(self.function.node, "a path that returns nothing", "a value on all")

    def text(self, name: str) -> str:
        passed = ", ".join(
            # Records do not change: LLVM need not read their parts again.
            f"ptr noalias readonly %a{i}" if isinstance(kind, Group) else f"{llvm_type(kind)} %a{i}"
            for i, kind in enumerate(_passed(self.function, self.types))
        )
        kind = "void" if self.result is None else llvm_type(self.result)
        decorators = self.function.decorators
        known = {"inline": "#1", "outline": "#2", "compact": "#3"}
        attributes = next((number for name, number in known.items() if name in decorators), "#0")
        lines = [f"define internal {kind} {name}({passed}) {attributes} {{", "entry:", *self._slots, "  br label %body"]
        for block in self._blocks:
            lines += [f"{block.label}:", *block.lines]
        return "\n".join([*lines, "}"])

    def _fresh(self) -> str:
        self._count += 1
        return f"%v{self._count}"

    def _label(self) -> str:
        self._count += 1
        return f"b{self._count}"

    def _emit(self, text: str) -> str:
        name = self._fresh()
        self._do(f"{name} = {text}")
        return name

    def _do(self, text: str) -> None:
        self._now.lines.append(f"  {text}")

    def _end(self, text: str) -> None:
        if not self._now.ended:
            self._do(text)
            self._now.ended = True

    def _begin(self, label: str) -> None:
        self._now = Block(label, [])
        self._blocks.append(self._now)

    def _branch(self, condition: Value, yes: str, no: str) -> None:
        self._end(f"br i1 {condition.name}, label %{yes}, label %{no}")

    def _slot(self, kind: str, align: int = 0) -> str:
        name = self._fresh()
        self._slots.append(f"  {name} = alloca {kind}" + (f", align {align}" if align else ""))
        return name

    def _refuse(self, node: ast.AST, got: str, want: str) -> NoReturn:
        raise SubsetError(f"{where(self.function, node)}: got {got}, want {want}")

    # Variables.

    def _store(self, name: str, value: Value, node: ast.AST) -> None:
        if name not in self._names:
            kind = self.widened.get(name, value.type)
            self._names[name] = kind, self._slots_of(kind)
        kind, slots = self._names[name]
        both = join(kind, value.type)
        if both is None:
            self._refuse(node, f"{describe(value.type)} for {name}, which is {describe(kind)}", "one type a name")
        if both != kind:
            self.widened[name] = both
            raise _Retyped
        self._put(slots, self._cast(value, kind, node))

    def _slots_of(self, kind: Type) -> Any:
        if isinstance(kind, Group):
            return [self._slots_of(member) for member in kind.members]
        return self._slot(llvm_type(kind))

    def _put(self, slots: Any, value: Value) -> None:
        if isinstance(slots, list):
            for slot, part in zip(slots, value.parts, strict=True):
                self._put(slot, part)
        else:
            self._do(f"store {llvm_type(value.type)} {value.name}, ptr {slots}")

    def _get(self, kind: Type, slots: Any) -> Value:
        if isinstance(kind, Group):
            members = (self._member_of(kind, slots, i) for i in range(len(kind.members)))
            return Value(kind, parts=tuple(self._get(*member) for member in members))
        if isinstance(slots, Address):
            slots = self._pointer_of(slots)
        return Value(kind, self._emit(f"load {llvm_type(kind)}, ptr {slots}"))

    def _member_of(self, kind: Group, slots: Any, place: int) -> tuple[Type, Any]:
        """The type and slots of a member of a record."""
        if not isinstance(slots, Address):
            return kind.members[place], slots[place]
        offset = sum(len(scalars(member)) for member in kind.members[:place])
        return kind.members[place], Address(self._at("i64", self._pointer_of(slots), offset))

    def _pointer_of(self, address: Address) -> str:
        return self._emit(f"load ptr, ptr {address.name}") if address.in_slot else address.name

    # Types.

    def _cast(self, value: Value, kind: Type, node: ast.AST) -> Value:
        if value.type == kind:
            return value
        if isinstance(value.constant, bool | int | float) and kind in (FLOAT, INT):
            return _constant(float(value.constant) if kind is FLOAT else int(value.constant))
        if kind is FLOAT and value.type in (INT, BOOL):
            convert = "sitofp" if value.type is INT else "uitofp"
            return Value(FLOAT, self._emit(f"{convert} {llvm_type(value.type)} {value.name} to double"))
        if kind is INT and value.type is BOOL:
            return Value(INT, self._emit(f"zext i1 {value.name} to i64"))
        if isinstance(kind, Group) and value.parts:
            parts = zip(value.parts, kind.members, strict=True)
            return Value(kind, parts=tuple(self._cast(part, member, node) for part, member in parts))
        self._refuse(node, describe(value.type), describe(kind))

    def _float(self, value: Value, node: ast.AST) -> str:
        if value.type not in (FLOAT, INT, BOOL):
            self._refuse(node, describe(value.type), "a number")
        return self._cast(value, FLOAT, node).name

    def _int(self, value: Value, node: ast.AST) -> str:
        if value.type not in (INT, BOOL):  # a constant float would be cast
            self._refuse(node, describe(value.type), "an int")
        return self._cast(value, INT, node).name

    def _condition(self, node: ast.expr) -> Value:
        value = self._decide(node) if isinstance(node, ast.BoolOp) else self._expression(node)
        if value.constant is not None:
            return _constant(bool(value.constant))
        if value.type is BOOL:
            return value
        if value.type is INT:
            return Value(BOOL, self._emit(f"icmp ne i64 {value.name}, 0"))
        self._refuse(node, f"{describe(value.type)} as a condition", "a comparison")

    # Statements.

    def _block(self, body: list[ast.stmt]) -> None:
        for statement in body:
            if self._now.ended:
                return
            method = getattr(self, f"_statement_{type(statement).__name__}", None)
            if method is None:
                self._refuse(statement, f"`{ast.unparse(statement).splitlines()[0]}`", "a statement of the subset")
            method(statement)

    def _statement_Pass(self, node: ast.Pass) -> None:
        pass

    def _statement_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            return
        if not isinstance(node.value, ast.Call):
            self._refuse(node, "an expression that is not used", "a call")
        self._call(node.value)

    def _statement_Assign(self, node: ast.Assign) -> None:
        targets, values = [node.targets], [node.value]
        match node.targets, node.value:
            case [ast.Tuple(elts=elements)], ast.Tuple(elts=parts) if len(elements) == len(parts):
                targets, values = [[target] for target in elements], parts
        results = [self._reference(expression) for expression in values]  # all of them, before any name changes
        for group, expression, value in zip(targets, values, results, strict=True):
            if self._has_own(value, expression):
                self._own |= {name.id for target in group for name in ast.walk(target) if isinstance(name, ast.Name)}
            for target in group:
                self._assign(target, value)

    def _has_own(self, value: Value, node: ast.expr) -> bool:
        """Whether a value may be or hold a work array of this function, which ends when the function returns."""
        names = {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}
        return bool(names & ({"stack", "zeros"} | self._own)) and any(
            isinstance(scalar, Pointer | Pointers) for scalar in scalars(value.type)
        )

    def _statement_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is None:
            self._refuse(node, "a name without a value", "an assignment")
        self._statement_Assign(ast.copy_location(ast.Assign([node.target], node.value), node))

    def _statement_AugAssign(self, node: ast.AugAssign) -> None:
        if isinstance(node.target, ast.Name):
            old = self._expression(ast.copy_location(ast.Name(node.target.id, ast.Load()), node.target))
            self._assign(node.target, self._arithmetic(node.op, old, self._expression(node.value), node))
            return
        address = self._address(node.target)
        old = Value(FLOAT, self._emit(f"load double, ptr {address}"))
        new = self._arithmetic(node.op, old, self._expression(node.value), node)
        self._do(f"store double {self._float(new, node)}, ptr {address}")

    def _assign(self, target: ast.expr, value: Value) -> None:
        match target:
            case ast.Name(id=name) if _is_address(value) and self._stores[name] == 1:
                slot = self._slot("ptr")
                self._do(f"store ptr {value.name}, ptr {slot}")
                self._names[name] = value.type, Address(slot, in_slot=True)
            case _ if _is_address(value):
                self._assign(target, self._get(value.type, Address(value.name)))
            case ast.Name(id=name):
                self._store(name, value, target)
            case ast.Tuple(elts=parts):
                if not isinstance(value.type, Group) or len(parts) != len(value.parts):
                    self._refuse(target, f"{describe(value.type)} for {len(parts)} names", "as many values")
                for element, part in zip(parts, value.parts, strict=True):
                    self._assign(element, part)
            case _:
                address = self._address(target)
                self._do(f"store double {self._float(value, target)}, ptr {address}")

    def _address(self, target: ast.expr) -> str:
        """The address of an entry of an array or a field of a struct."""
        if isinstance(target, ast.Subscript):
            if isinstance(entry := self._entry(self._expression(target.value), target), str):
                return entry
        elif isinstance(target, ast.Attribute):
            row = self._expression(target.value)
            if _is_struct(row.type) and target.attr in row.type.fields:
                return self._at("double", row.name, row.type.fields.index(target.attr))
        self._refuse(target, f"`{ast.unparse(target)}` assigned to", "a name, an entry or a field of a struct")

    def _at(self, kind: str, pointer: str, place: int | str) -> str:
        """The address of an entry, of LLVM's type `kind`."""
        return self._emit(f"getelementptr inbounds {kind}, ptr {pointer}, i64 {place}")

    def _library(self, name: str, *numbers: str, fast: str = "") -> Value:
        """A call of an intrinsic or a C library function of floats."""
        function = self.program.declare(name, "double", ", ".join(["double"] * len(numbers)))
        arguments = ", ".join(f"double {number}" for number in numbers)
        return Value(FLOAT, self._emit(f"call{fast} double {function}({arguments})"))

    def _statement_Return(self, node: ast.Return) -> None:
        if node.value is None:
            self._empty = True
            self._end("ret void")
            return
        value = self._expression(node.value)
        if self._has_own(value, node.value):
            self._refuse(node, "a work array returned", "one that the function is given")
        if isinstance(value.type, Group) and not value.parts:
            self._refuse(node, "an empty tuple", "numbers and arrays")
        if self.result is None:
            self.result = value.type
        both = join(self.result, value.type)
        if both is None:
            self._refuse(node, describe(value.type), f"{describe(self.result)}, as it returns elsewhere")
        if both != self.result:
            self.result = both
            raise _Retyped
        value = self._cast(value, both, node)
        if not value.parts:
            self._end(f"ret {llvm_type(both)} {value.name}")
            return
        if any(isinstance(part.type, Group) for part in value.parts):
            self._refuse(node, "a tuple of tuples", "numbers and arrays")
        total = "undef"
        for i, part in enumerate(value.parts):
            total = self._emit(f"insertvalue {llvm_type(both)} {total}, {llvm_type(part.type)} {part.name}, {i}")
        self._end(f"ret {llvm_type(both)} {total}")

    def _statement_If(self, node: ast.If) -> None:
        test = self._condition(node.test)
        if test.constant is not None:
            self._block(node.body if test.constant else node.orelse)
            return
        yes, no, end = self._label(), self._label(), self._label()
        self._branch(test, yes, no if node.orelse else end)
        reached = not node.orelse
        for label, body in ((yes, node.body), (no, node.orelse)):
            if body:
                self._begin(label)
                self._block(body)
                reached = reached or not self._now.ended
                self._end(f"br label %{end}")
        if reached:
            self._begin(end)

    def _statement_While(self, node: ast.While) -> None:
        if node.orelse:
            self._refuse(node, "an else after a loop", "none")
        head, body, end = self._label(), self._label(), self._label()
        self._end(f"br label %{head}")
        self._begin(head)
        test = self._condition(node.test)
        if test.constant is not None and not test.constant:
            return
        self._branch(test, body, end if test.constant is None else body)
        self._begin(body)
        self._loops.append((head, end))
        self._block(node.body)
        self._loops.pop()
        self._end(f"br label %{head}")
        if test.constant is None or end in self._left:
            self._begin(end)

    def _statement_For(self, node: ast.For) -> None:
        match node:
            case ast.For(
                target=ast.Name(id=name), iter=ast.Call(func=ast.Name("range"), args=bounds, keywords=[]), orelse=[]
            ) if 1 <= len(bounds) <= 3:
                pass
            case _:
                self._refuse(node, f"`{ast.unparse(node).splitlines()[0]}`", "for NAME in range(...), without an else")
        values = [self._expression(bound) for bound in bounds]
        numbers = [self._int(value, node) for value in values]
        start, stop, step = ("0", numbers[0], "1") if len(numbers) == 1 else (*numbers, "1")[:3]
        size = values[2].constant if len(values) == 3 else 1
        if not isinstance(size, int) or size == 0:
            self._refuse(node, "a step that is not constant", "a constant one, not 0")
        counter = self._slot("i64")
        self._do(f"store i64 {start}, ptr {counter}")
        head, body, more, end = (self._label() for _ in range(4))
        self._end(f"br label %{head}")
        self._begin(head)
        now = self._emit(f"load i64, ptr {counter}")
        going = self._emit(f"icmp {'slt' if size > 0 else 'sgt'} i64 {now}, {stop}")
        self._branch(Value(BOOL, going), body, end)
        self._begin(body)
        self._store(name, Value(INT, now), node)
        self._loops.append((more, end))
        self._block(node.body)
        self._loops.pop()
        self._end(f"br label %{more}")
        self._begin(more)
        now = self._emit(f"load i64, ptr {counter}")
        self._do(f"store i64 {self._emit(f'add nsw i64 {now}, {step}')}, ptr {counter}")
        self._end(f"br label %{head}")
        self._begin(end)

    def _statement_Break(self, node: ast.Break) -> None:
        end = self._loop(node)[1]
        self._left.add(end)
        self._end(f"br label %{end}")

    def _statement_Continue(self, node: ast.Continue) -> None:
        self._end(f"br label %{self._loop(node)[0]}")

    def _loop(self, node: ast.stmt) -> tuple[str, str]:
        """The labels where the loop around a statement continues, and where it ends."""
        if not self._loops:
            self._refuse(node, f"`{ast.unparse(node)}` outside of a loop", "a loop around it")
        return self._loops[-1]

    # Expressions.

    def _expression(self, node: ast.expr) -> Value:
        method = getattr(self, f"_expression_{type(node).__name__}", None)
        if method is None:
            self._refuse(node, f"`{ast.unparse(node)}`", "an expression of the subset")
        return method(node)

    def _expression_Constant(self, node: ast.Constant) -> Value:
        if not isinstance(node.value, bool | int | float):
            self._refuse(node, f"`{ast.unparse(node)}`", "a number")
        return self._number(node.value, node)

    def _number(self, number: bool | int | float, node: ast.AST) -> Value:
        if isinstance(number, int) and not -(1 << 63) <= number < 1 << 63:
            self._refuse(node, "an int of more than 64 bits", "a smaller one")
        return _constant(number)

    def _expression_Name(self, node: ast.Name) -> Value:
        if node.id in self._names:
            return self._get(*self._names[node.id])
        if node.id in self._constants:
            return self._constants[node.id]
        meaning = self.scope.find(node.id)
        if node.id in self._local:
            self._refuse(node, f"the name {node.id}, which has no value yet", "a value assigned before")
        if meaning is None:
            self._refuse(node, f"the name {node.id}, which is not defined", "a defined one")
        if isinstance(meaning, ScopedFunction | Word | Record):
            self._refuse(node, f"the function {node.id} as a value", "a call of it")
        return _constant(meaning)

    def _expression_Tuple(self, node: ast.Tuple) -> Value:
        return _group([self._expression(entry) for entry in node.elts])

    def _expression_Attribute(self, node: ast.Attribute) -> Value:
        part = self._part(node)
        if part is not None:  # loaded without the rest of the record
            return self._get(*part)
        value = self._expression(node.value)
        fields = value.type.fields if isinstance(value.type, Group) or _is_struct(value.type) else ()
        if node.attr not in fields:
            self._refuse(node, f".{node.attr} of {describe(value.type)}", f"one of: {', '.join(fields) or '(none)'}")
        place = fields.index(node.attr)
        if _is_struct(value.type):
            return Value(FLOAT, self._emit(f"load double, ptr {self._at('double', value.name, place)}"))
        return value.parts[place]

    def _reference(self, node: ast.expr) -> Value:
        """The value of an expression; for a record that is in memory, its address."""
        match self._part(node):
            case Group() as kind, Address() as address:
                return Value(kind, self._pointer_of(address))
        return self._expression(node)

    def _part(self, node: ast.expr) -> tuple[Type, Any] | None:
        """The type and slots of a variable, or of a field of one that holds a record; None for anything else."""
        if isinstance(node, ast.Name):
            return self._names.get(node.id)
        if not isinstance(node, ast.Attribute):
            return None
        match self._part(node.value):
            case Group(fields=fields) as kind, slots if node.attr in fields:
                return self._member_of(kind, slots, fields.index(node.attr))
        return None

    def _expression_Subscript(self, node: ast.Subscript) -> Value:
        entry = self._entry(self._expression(node.value), node)
        return Value(FLOAT, self._emit(f"load double, ptr {entry}")) if isinstance(entry, str) else entry

    def _entry(self, base: Value, node: ast.Subscript) -> Value | str:
        """The part of a value at an index; the address of an array's entry."""
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        values = [self._expression(index) for index in indices]
        if any(isinstance(value.constant, int) and value.constant < 0 for value in values):
            self._refuse(node, "a negative index", "one from 0 on")
        if not values or (not isinstance(base.type, Group) and any(value.type is BOOL for value in values)):
            self._refuse(node, f"`{ast.unparse(node)}`", "ints as indices")
        match base.type:
            case Pointer(block=block, fields=fields) if len(values) <= len(block) + (not fields):
                total = None
                for i, value in enumerate(values):
                    number, stride = self._int(value, node), math.prod(block[i:])
                    number = self._emit(f"mul nsw i64 {number}, {stride}") if stride != 1 else number
                    total = number if total is None else self._emit(f"add nsw i64 {total}, {number}")
                address, left = self._at("double", base.name, str(total)), block[len(values) :]
                return address if len(values) == len(block) + 1 else Value(Pointer(left, fields), address)
            case Pointers() if len(values) == 1:
                address = self._at("ptr", base.name, self._int(values[0], node))
                return Value(VECTOR, self._emit(f"load ptr, ptr {address}"))
            case Group() if len(values) == 1:
                return self._member(base, values[0], node)
        self._refuse(node, f"{len(values)} indices of {describe(base.type)}", "as many as it has")

    def _member(self, group: Value, index: Value, node: ast.AST) -> Value:
        if isinstance(index.constant, int):
            if index.constant >= len(group.parts):
                self._refuse(node, f"entry {index.constant} of {len(group.parts)}", "a smaller one")
            return group.parts[index.constant]
        kinds = {part.type for part in group.parts}
        if len(kinds) != 1 or isinstance((kind := kinds.pop()), Group):
            self._refuse(node, "an index that is not constant, of a tuple of several types", "a constant one")
        of = llvm_type(kind)
        table = self._slot(f"[{len(group.parts)} x {of}]")
        for i, part in enumerate(group.parts):
            self._do(f"store {of} {part.name}, ptr {self._at(of, table, i)}")
        address = self._at(of, table, self._int(index, node))
        return Value(kind, self._emit(f"load {of}, ptr {address}"))

    def _expression_UnaryOp(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            value = self._condition(node.operand)
            if value.constant is not None:
                return _constant(not value.constant)
            return Value(BOOL, self._emit(f"xor i1 {value.name}, true"))
        value = self._expression(node.operand)
        if not isinstance(node.op, ast.USub | ast.UAdd):
            self._refuse(node, f"`{ast.unparse(node)}`", "-, + or not")
        if isinstance(node.op, ast.UAdd):
            return value if value.type is FLOAT else self._cast(value, INT, node)
        if _is_number(value.constant):
            return self._number(-value.constant, node)
        if value.type is FLOAT:
            return Value(FLOAT, self._emit(f"fneg {self._fast} double {value.name}"))
        return Value(INT, self._emit(f"sub nsw i64 0, {self._int(value, node)}"))

    def _expression_BinOp(self, node: ast.BinOp) -> Value:
        return self._arithmetic(node.op, self._expression(node.left), self._expression(node.right), node)

    def _arithmetic(self, op: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        if type(op) not in _OPERATORS:
            self._refuse(node, f"`{ast.unparse(node)}`", "+, -, *, /, //, % or **")
        name, plainly = _OPERATORS[type(op)]
        large = name == "pow" and isinstance(right.constant, int) and right.constant > MOST_FACTORS
        if _is_number(left.constant) and _is_number(right.constant) and not large:
            try:
                return self._number(plainly(left.constant, right.constant), node)
            except (ArithmeticError, TypeError):  # for example a division by zero, which is left to the processor
                pass
        if name == "pow":
            return self._power(left, right, node)
        if name != "div" and left.type in (INT, BOOL) and right.type in (INT, BOOL):
            return self._whole(name, self._int(left, node), self._int(right, node))
        a, b = self._float(left, node), self._float(right, node)
        if name in ("floordiv", "mod"):
            remainder = self._emit(f"frem double {a}, {b}")
            signs = [self._emit(f"fcmp olt double {number}, {_hex(0.0)}") for number in (remainder, b)]
            unlike = self._emit(f"xor i1 {signs[0]}, {signs[1]}")
            inexact = self._emit(f"fcmp one double {remainder}, {_hex(0.0)}")
            down = self._emit(f"and i1 {unlike}, {inexact}")
            if name == "mod":
                shift = self._emit(f"select i1 {down}, double {b}, double {_hex(0.0)}")
                return Value(FLOAT, self._emit(f"fadd double {remainder}, {shift}"))
            quotient = self._emit(f"fdiv double {self._emit(f'fsub double {a}, {remainder}')}, {b}")
            quotient = self._library("llvm.rint.f64", quotient).name
            return Value(FLOAT, self._emit(f"fsub double {quotient}, {self._emit(f'uitofp i1 {down} to double')}"))
        return Value(FLOAT, self._emit(f"f{name} {self._fast} double {a}, {b}"))

    def _whole(self, name: str, a: str, b: str) -> Value:
        if name in ("add", "sub", "mul"):
            return Value(INT, self._emit(f"{name} nsw i64 {a}, {b}"))
        none = self._emit(f"icmp eq i64 {b}, 0")  # because a division by zero would end the process
        a, b = self._emit(f"select i1 {none}, i64 0, i64 {a}"), self._emit(f"select i1 {none}, i64 1, i64 {b}")
        quotient, remainder = self._emit(f"sdiv i64 {a}, {b}"), self._emit(f"srem i64 {a}, {b}")
        # Python rounds down, the processor towards zero.
        signs = self._emit(f"icmp slt i64 {self._emit(f'xor i64 {remainder}, {b}')}, 0")
        down = self._emit(f"and i1 {signs}, {self._emit(f'icmp ne i64 {remainder}, 0')}")
        if name == "floordiv":
            return Value(INT, self._emit(f"sub nsw i64 {quotient}, {self._emit(f'zext i1 {down} to i64')}"))
        return Value(INT, self._emit(f"add nsw i64 {remainder}, {self._emit(f'select i1 {down}, i64 {b}, i64 0')}"))

    def _power(self, base: Value, exponent: Value, node: ast.AST) -> Value:
        number = exponent.constant
        if isinstance(number, int) and abs(number) <= MOST_FACTORS:
            total, square, left = None, base, abs(number)
            while left:  # by squaring
                if left & 1:
                    total = square if total is None else self._arithmetic(ast.Mult(), total, square, node)
                left >>= 1
                square = self._arithmetic(ast.Mult(), square, square, node) if left else square
            total = _constant(1 if base.type is INT else 1.0) if total is None else total
            return self._arithmetic(ast.Div(), _constant(1.0), total, node) if number < 0 else total
        if exponent.type is not FLOAT and base.type is not FLOAT:
            self._refuse(node, "a whole exponent of an int that is not constant", "a float")
        return self._library("llvm.pow.f64", self._float(base, node), self._float(exponent, node))

    def _expression_Compare(self, node: ast.Compare) -> Value:
        left, total = self._expression(node.left), None
        for op, comparator in zip(node.ops, node.comparators, strict=True):
            right = self._expression(comparator)
            outcome = self._compare(op, left, right, node)
            if total is None:
                total = outcome
            elif total.constant is not None and outcome.constant is not None:
                total = _constant(bool(total.constant and outcome.constant))
            else:
                total = Value(BOOL, self._emit(f"and i1 {total.name}, {outcome.name}"))
            left = right
        assert total is not None
        return total

    def _compare(self, op: ast.cmpop, left: Value, right: Value, node: ast.AST) -> Value:
        if type(op) not in _COMPARISONS:
            self._refuse(node, f"`{ast.unparse(node)}`", "<, <=, >, >=, == or !=")
        name, plainly = _COMPARISONS[type(op)]
        if _is_number(left.constant) and _is_number(right.constant):
            return _constant(bool(plainly(left.constant, right.constant)))
        if left.type in (INT, BOOL) and right.type in (INT, BOOL):
            signed = name if name in ("eq", "ne") else f"s{name}"
            a, b = self._int(left, node), self._int(right, node)
            return Value(BOOL, self._emit(f"icmp {signed} i64 {a}, {b}"))
        a, b = self._float(left, node), self._float(right, node)
        ordered = f"u{name}" if name == "ne" else f"o{name}"  # a NaN is only unequal
        return Value(BOOL, self._emit(f"fcmp {ordered} double {a}, {b}"))

    def _expression_BoolOp(self, node: ast.BoolOp) -> Value:
        return self._decide(node, of_bools=True)

    def _decide(self, node: ast.BoolOp, of_bools: bool = False) -> Value:
        """Evaluate operands until one decides; `of_bools` refuses non-bools, which are conditions but no values."""
        decides = isinstance(node.op, ast.Or)
        end, slot, pending = self._label(), "", False
        for i, operand in enumerate(node.values):
            value = self._expression(operand) if of_bools else self._condition(operand)
            if value.type is not BOOL:
                self._refuse(node, f"{describe(value.type)} as a value of `{ast.unparse(node)}`", "a bool")
            last = i + 1 == len(node.values)
            if value.constant is not None:
                if bool(value.constant) != decides and not last:
                    continue
                if not pending:
                    return _constant(bool(value.constant))
            slot = slot or self._slot("i1")
            self._do(f"store i1 {value.name}, ptr {slot}")
            if last or value.constant is not None:
                break
            more, pending = self._label(), True
            self._branch(value, *((end, more) if decides else (more, end)))
            self._begin(more)
        self._end(f"br label %{end}")
        self._begin(end)
        return Value(BOOL, self._emit(f"load i1, ptr {slot}"))

    def _expression_IfExp(self, node: ast.IfExp) -> Value:
        test = self._condition(node.test)
        if test.constant is not None:
            return self._expression(node.body if test.constant else node.orelse)
        yes, no, end = self._label(), self._label(), self._label()
        self._branch(test, yes, no)
        branches = []
        for label, branch in ((yes, node.body), (no, node.orelse)):
            self._begin(label)
            branches.append((self._expression(branch), self._now))
        kind = join(branches[0][0].type, branches[1][0].type)
        if kind is None:
            self._refuse(node, f"{describe(branches[0][0].type)} or {describe(branches[1][0].type)}", "one type")
        slots = self._slots_of(kind)
        for value, self._now in branches:  # the common type is known only now
            self._put(slots, self._cast(value, kind, node))
            self._end(f"br label %{end}")
        self._begin(end)
        return self._get(kind, slots)

    # Calls.

    def _expression_Call(self, node: ast.Call) -> Value:
        value = self._call(node)
        if value is None:
            self._refuse(node, f"`{ast.unparse(node)}`, which returns nothing", "a value")
        return value

    def _call(self, node: ast.Call) -> Value | None:
        if not isinstance(node.func, ast.Name) or node.keywords:
            self._refuse(node, f"`{ast.unparse(node)}`", "a call by a bare name, of positional arguments")
        name = node.func.id
        meaning = self.scope.find(name) if name not in self._local else None
        by_address = isinstance(meaning, ScopedFunction) and _by_address(meaning)
        values = [self._reference(argument) if by_address else self._expression(argument) for argument in node.args]
        match meaning:
            case ScopedFunction():
                return self._call_kernel(meaning, values, node)
            case Record(name=record, fields=fields):
                if len(values) != len(fields):
                    self._refuse(node, f"{len(values)} fields of {record}", str(len(fields)))
                return Value(Group(tuple(value.type for value in values), record, fields), parts=tuple(values))
            case Word():
                return self._call_word(meaning.name, values, node)
        self._refuse(node, f"a call of {name}", "a kernel, a record or a word of `codegen/language.py`")

    def _call_kernel(self, function: ScopedFunction, arguments: list[Value], node: ast.Call) -> Value | None:
        count = len(function.node.args.args)
        if len(arguments) != count:
            self._refuse(node, f"{len(arguments)} arguments for {function.node.name}", str(count))
        symbol, result = self.program.instance(function, tuple(value.type for value in arguments))
        if _by_address(function):
            arguments = [self._in_memory(value) if isinstance(value.type, Group) else value for value in arguments]
        parts = [part for value in arguments for part in ([value] if _is_address(value) else _leaves(value))]
        passed = ", ".join(f"{_passed_type(part.type)} {part.name}" for part in parts)
        if result is None:
            self._do(f"call void {symbol}({passed})")
            return None
        returned = self._emit(f"call {llvm_type(result)} {symbol}({passed})")
        if not isinstance(result, Group):
            return Value(result, returned)
        extract = f"extractvalue {llvm_type(result)} {returned}"
        return _assemble(result, iter([self._emit(f"{extract}, {i}") for i in range(len(result.members))]))

    def _in_memory(self, value: Value) -> Value:
        """The address of a record, which is written to memory if it is not there."""
        if _is_address(value):
            return value
        parts = _leaves(value)
        table = self._slot(f"[{len(parts)} x i64]", 8)
        for i, part in enumerate(parts):
            self._do(f"store {llvm_type(part.type)} {part.name}, ptr {self._at('i64', table, i)}")
        return Value(value.type, table)

    def _call_word(self, name: str, arguments: list[Value], node: ast.Call) -> Value | None:
        method, count = getattr(self, f"_word_{name}", None), _COUNTS.get(name, 2 if name in BINARY else 1)
        if name in _MANY and len(arguments) < count:
            self._refuse(node, f"{len(arguments)} arguments in `{ast.unparse(node)}`", f"{count} or more")
        if name not in _MANY and len(arguments) != count:
            self._refuse(node, f"{len(arguments)} arguments in `{ast.unparse(node)}`", str(count))
        if method is not None:
            return method(arguments, node)
        if name in UNARY or name in BINARY:
            library = UNARY.get(name) or BINARY[name]
            fast = f" {self._fast}" if library.startswith("llvm.") and name not in ("copysign", "pow") else ""
            return self._library(library, *(self._float(value, node) for value in arguments), fast=fast)
        if name in SCALES:
            return self._arithmetic(ast.Mult(), arguments[0], _constant(float(SCALES[name])), node)
        if name in TESTS:
            number = self._float(arguments[0], node)
            if name == "isnan":
                return Value(BOOL, self._emit(f"fcmp uno double {number}, {number}"))
            size, test = self._library("llvm.fabs.f64", number), "oeq" if name == "isinf" else "olt"
            return Value(BOOL, self._emit(f"fcmp {test} double {size.name}, {_hex(math.inf)}"))
        self._refuse(node, f"a call of {name}", "a word of `codegen/language.py`")

    def _extreme(self, arguments: list[Value], node: ast.AST, op: ast.cmpop, plainly: Callable[..., Any]) -> Value:
        total = arguments[0]
        for other in arguments[1:]:
            if _is_number(total.constant) and _is_number(other.constant):
                total = _constant(plainly(total.constant, other.constant))
                continue
            kind = join(total.type, other.type)
            if kind not in (FLOAT, INT):
                self._refuse(node, f"{describe(total.type)} and {describe(other.type)}", "numbers")
            a, b = self._cast(total, kind, node), self._cast(other, kind, node)
            better = self._compare(op, b, a, node)
            of = llvm_type(kind)
            total = Value(kind, self._emit(f"select i1 {better.name}, {of} {b.name}, {of} {a.name}"))
        return total

    _word_min = functools.partialmethod(_extreme, op=ast.Lt(), plainly=min)
    _word_max = functools.partialmethod(_extreme, op=ast.Gt(), plainly=max)

    def _word_abs(self, arguments: list[Value], node: ast.AST) -> Value:
        if arguments[0].type in (INT, BOOL):
            number = self._int(arguments[0], node)
            negative = self._emit(f"icmp slt i64 {number}, 0")
            minus = self._emit(f"sub nsw i64 0, {number}")
            return Value(INT, self._emit(f"select i1 {negative}, i64 {minus}, i64 {number}"))
        return self._library("llvm.fabs.f64", self._float(arguments[0], node))

    def _word_int(self, arguments: list[Value], node: ast.AST) -> Value:
        if arguments[0].type is FLOAT:
            return Value(INT, self._emit(f"fptosi double {arguments[0].name} to i64"))
        return Value(INT, self._int(arguments[0], node))

    def _word_float(self, arguments: list[Value], node: ast.AST) -> Value:
        return Value(FLOAT, self._float(arguments[0], node))

    def _word_len(self, arguments: list[Value], node: ast.AST) -> Value:
        if not isinstance(arguments[0].type, Group):
            self._refuse(node, f"the length of {describe(arguments[0].type)}", "that of a tuple")
        return _constant(len(arguments[0].parts))

    def _word_stack(self, arguments: list[Value], node: ast.AST) -> Value:
        shape = [size.constant for size in arguments if isinstance(size.constant, int) and size.constant >= 0]
        if not shape or len(shape) < len(arguments):
            self._refuse(node, f"`{ast.unparse(node)}`", "constant sizes")
        total = math.prod(shape)
        if total > MOST_ON_STACK:
            self._refuse(node, f"`{ast.unparse(node)}`", f"at most {MOST_ON_STACK} numbers")
        return Value(Pointer(tuple(shape[1:])), self._slot(f"[{max(total, 1)} x double]", 64))

    def _word_zeros(self, arguments: list[Value], node: ast.Call) -> Value:
        value = self._word_stack(arguments, node)
        size = 8 * math.prod(size.constant for size in arguments)  # pyright: ignore[reportArgumentType, reportCallIssue]
        memset = self.program.declare("llvm.memset.p0.i64", "void", "ptr, i8, i64, i1")
        self._do(f"call void {memset}(ptr align 64 {value.name}, i8 0, i64 {size}, i1 false)")
        return value

    def _pointer(self, address: Value, node: ast.AST) -> str:
        if address.type not in (FLOAT, INT):
            self._refuse(node, describe(address.type), "an address")
        number = address.name
        if address.type is FLOAT:
            number = self._emit(f"fptosi double {number} to i64")
        return self._emit(f"inttoptr i64 {number} to ptr")

    def _word_at(self, arguments: list[Value], node: ast.AST) -> Value:
        return Value(VECTOR, self._pointer(arguments[0], node))

    def _word_rows_at(self, arguments: list[Value], node: ast.AST) -> Value:
        if not isinstance(arguments[1].constant, int) or arguments[1].constant < 1:
            self._refuse(node, "a width that is not constant", "a constant one, of at least 1")
        return Value(Pointer((arguments[1].constant,)), self._pointer(arguments[0], node))

    def _word_int32(self, arguments: list[Value], node: ast.AST) -> Value:
        return Value(INT32, self._emit(f"trunc i64 {self._int(arguments[0], node)} to i32"))

    def _word_power_of_two(self, arguments: list[Value], node: ast.AST) -> Value:
        # Added to 1.5 2^52, the exponent is in the lowest bits of the sum; shifted by 52 bits, it is in its place.
        biased = self._emit(f"fadd double {self._float(arguments[0], node)}, {_hex(1.5 * 2.0**52 + 1023)}")
        bits = self._emit(f"shl i64 {self._emit(f'bitcast double {biased} to i64')}, 52")
        return Value(FLOAT, self._emit(f"bitcast i64 {bits} to double"))

    def _c_call(self, kind: str, arguments: list[Value], node: ast.AST) -> str:
        function = self._pointer(arguments[0], node)
        parts = [part for value in arguments[1:] for part in _leaves(value)]
        parts = [self._cast(part, INT, node) if part.type is BOOL else part for part in parts]
        return f"call {kind} {function}({', '.join(f'{llvm_type(part.type)} {part.name}' for part in parts)})"

    def _word_call(self, arguments: list[Value], node: ast.AST) -> None:
        self._do(self._c_call("void", arguments, node))

    def _word_call_for_value(self, arguments: list[Value], node: ast.AST) -> Value:
        return Value(FLOAT, self._emit(self._c_call("double", arguments, node)))

    def _shared(self, arguments: list[Value], node: ast.AST) -> str:
        """The address of an int64 that threads share."""
        return self._at("i64", self._pointer(arguments[0], node), self._int(arguments[1], node))

    def _word_claim(self, arguments: list[Value], node: ast.AST) -> Value:
        outcome = self._emit(f"cmpxchg ptr {self._shared(arguments, node)}, i64 0, i64 1 acq_rel acquire")
        won = self._emit(f"extractvalue {{i64, i1}} {outcome}, 1")
        return Value(INT, self._emit(f"zext i1 {won} to i64"))

    def _word_load(self, arguments: list[Value], node: ast.AST) -> Value:
        return Value(INT, self._emit(f"load atomic i64, ptr {self._shared(arguments, node)} acquire, align 8"))

    def _word_store(self, arguments: list[Value], node: ast.AST) -> None:
        number = self._int(arguments[2], node)
        self._do(f"store atomic i64 {number}, ptr {self._shared(arguments, node)} release, align 8")

    def _word_fetch_add(self, arguments: list[Value], node: ast.AST) -> Value:
        number = self._int(arguments[2], node)
        return Value(INT, self._emit(f"atomicrmw add ptr {self._shared(arguments, node)}, i64 {number} acq_rel"))


def _hex(number: float) -> str:
    """A float64 as an exact literal of LLVM."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', number))[0]:016X}"


def _is_number(constant: Constant | None) -> TypeGuard[bool | int | float]:
    return isinstance(constant, bool | int | float)


def _constant(number: Constant) -> Value:
    if isinstance(number, bool):
        return Value(BOOL, "true" if number else "false", constant=number)
    if isinstance(number, int):
        return Value(INT, str(number), constant=number)
    if isinstance(number, float):
        return Value(FLOAT, _hex(number), constant=number)
    return _group([_constant(entry) for entry in number])


def _group(parts: list[Value]) -> Value:
    constants = tuple(part.constant for part in parts)
    constant: Any = None if None in constants else constants
    return Value(Group(tuple(part.type for part in parts)), parts=tuple(parts), constant=constant)


def _by_address(function: ScopedFunction) -> bool:
    """Whether a function takes records by address."""
    return "compact" in function.decorators


def _passed(function: ScopedFunction, types: tuple[Type, ...]) -> list[Type]:
    """The types that a function takes in LLVM: records, if by address, and parts of records otherwise."""
    return list(types) if _by_address(function) else [scalar for kind in types for scalar in scalars(kind)]


def _passed_type(kind: Type) -> str:
    """LLVM's name of the type of an argument."""
    return "ptr" if isinstance(kind, Group) else llvm_type(kind)


def _is_struct(kind: Type) -> TypeGuard[Pointer]:
    return isinstance(kind, Pointer) and not kind.block and bool(kind.fields)


def _is_address(value: Value) -> bool:
    return isinstance(value.type, Group) and bool(value.name)


def _leaves(value: Value) -> list[Value]:
    if isinstance(value.type, Group):
        return [leaf for part in value.parts for leaf in _leaves(part)]
    return [value]


def _assemble(kind: Type, names: Any) -> Value:
    """A value of a type, from LLVM's names of its parts."""
    if isinstance(kind, Group):
        return Value(kind, parts=tuple(_assemble(member, names) for member in kind.members))
    return Value(kind, next(names))
