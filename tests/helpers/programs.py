"""Random programs in the kernels' subset; `program` writes one from a function that chooses.

They end, and do nothing that is undefined: indices are within their arrays, ints stay small, no divisor is zero, and
each name has a value when it is read.
"""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import strategies as st
from rounding import tracked

from lqrsim.errors import Array
from lqrsim.kernels.records import Limits

ROWS, COLUMNS, PLANES = 3, 4, 2  # a vector has COLUMNS numbers, a matrix ROWS of these, a block PLANES matrices
SIZES = {"N": COLUMNS, "M": ROWS}  # what declarations.py declares, and programs use as constants
FIELDS = ("cost", "gap", "method")  # of a row
SMOOTH = ("sin({})", "cos({})", "tanh({})", "atan({})", "exp(min({}, 3.0))", "sqrt(1.0 + abs({}))",
          "log(0.5 + fabs({}))", "cbrt(2.0 + abs({}))", "expm1(min({}, 2.0))", "log1p(abs({}))")  # fmt: skip
MOST = 200  # bound on ints; larger ones are reduced

Choose = Callable[[int], int]  # one of so many


class Writer:
    """Writes functions, line by line.

    `reals`, `wholes` and `truths` are texts of what has a value by now; `vectors` and `matrices` the names of arrays.
    """

    def __init__(self, choose: Choose) -> None:
        self._choose = choose
        self.lines: list[str] = []
        self.indent = 1
        self.loops: list[str] = []
        self.returns: Callable[[], str] | None = None
        self.reals: list[str] = []
        self.wholes: list[str] = []
        self.truths: list[str] = []
        self.vectors: list[str] = []
        self.matrices: list[str] = []
        self.blocks: list[str] = []
        self.rows = ""
        self.assigned: dict[str, list[str]] = {"real": [], "whole": [], "truth": []}
        self.helpers = False

    def one(self, options: Any) -> Any:
        return options[self._choose(len(options))]

    def often(self, times: int = 2) -> bool:
        return self._choose(times) > 0

    def line(self, text: str) -> None:
        self.lines.append("    " * self.indent + text)

    # Expressions.

    def index(self, size: int) -> str:
        if self.often():
            return str(self._choose(size))
        text, _ = self.whole(1)
        return self.one([f"({text}) % {size}", f"min(abs({text}), {size - 1})"])

    def vector(self) -> str:
        """An array of COLUMNS numbers."""
        kind = self._choose(4)
        if kind == 0 and self.matrices:
            return f"{self.one(self.matrices)}[{self.index(ROWS)}]"
        if kind == 1 and self.blocks:
            between = self.one((", ", "]["))
            return f"{self.one(self.blocks)}[{self.index(PLANES)}{between}{self.index(ROWS)}]"
        return self.one(self.vectors)

    def entry(self) -> str:
        """A place that a number can be stored in: an entry of an array or of a row."""
        kind = self._choose(5)
        if kind == 0 and self.rows:
            return f"{self.rows}[{self.index(ROWS)}].{self.one(FIELDS)}"
        if kind == 1 and self.blocks:
            return f"{self.one(self.blocks)}[{self.index(PLANES)}, {self.index(ROWS)}, {self.index(COLUMNS)}]"
        if kind == 2 and self.matrices:
            return f"{self.one(self.matrices)}[{self.index(ROWS)}, {self.index(COLUMNS)}]"
        return f"{self.vector()}[{self.index(COLUMNS)}]"

    def whole(self, depth: int) -> tuple[str, int]:
        """An int expression and a bound on its size."""
        if depth == 0 or not self.often(4):
            if self.wholes and self.often():
                return self.one(self.wholes), MOST
            number = self._choose(19) - 9
            return (str(number) if number >= 0 else f"({number})"), abs(number)
        (a, most_a), (b, most_b) = self.whole(depth - 1), self.whole(depth - 1)
        truth = self.truth(depth - 1)
        options = [
            (f"({a} + {b})", most_a + most_b), (f"({a} - {b})", most_a + most_b), (f"({a} * {b})", most_a * most_b),
            (f"({a} // (abs({b}) + 1))", most_a), (f"({a} % (2 * {b} + 1))", 2 * most_b + 1),
            (f"(-{a})", most_a), (f"min({a}, {b})", max(most_a, most_b)), (f"max({a}, {b}, 1)", max(most_a, most_b, 1)),
            (f"abs({a})", most_a), (f"({a} if {truth} else {b})", max(most_a, most_b)),
            (f"({a} - {truth})", most_a + 1), (f"int({truth})", 1), (f"({a} // {self._choose(5) - 6})", most_a),
            (f"({a} % {self._choose(5) - 6})", 6), ("len((1, 2.0, N))", 3),
            (f"({b}, {a}, {b})[{a} % 3]", most_a + most_b),
            (f"int(max(min({self.real(depth - 1)}, 50.0), -50.0))", 50),
        ]  # fmt: skip
        if most_a <= MOST:
            options += [(f"({a} ** 2)", most_a**2), (f"(+{a}) ** 3", most_a**3)]
        text, most = self.one(options)
        return (text, most) if most < 10**9 else (f"({text} % 101)", 101)

    def small(self, depth: int) -> str:
        """An int that a variable may have."""
        text, most = self.whole(depth)
        return text if most <= MOST else self.one([f"{text} % {MOST}", f"max(min({text}, {MOST}), -{MOST})"])

    def real(self, depth: int) -> str:
        """A float expression, or an int where only the type differs."""
        if depth == 0 or not self.often(4):
            kind = self._choose(6)
            if kind == 0:
                return str((self._choose(65) - 32) / 8).replace("-", "0.0 - ") if self.often() else "0.25"
            if kind == 1:
                return f"float({self.whole(0)[0]})"
            if kind == 2:
                return self.entry()
            return self.one(self.reals)
        a, b = self.real(depth - 1), self.real(depth - 1)
        whole, truth, few = self.whole(depth - 1)[0], self.truth(depth - 1), self._choose(4)
        options = [
            f"({a} + {b})", f"({a} - {b})", f"({a}) * ({b})", f"(({a}) + {whole})", f"({whole} * ({a}))",
            f"({a}) / (1.5 + abs({b}))", f"({a}) / 3", f"({whole} / (2.0 + abs({b})))", f"({a}) // (1.0 + abs({b}))",
            f"({a}) % (0.5 + abs({b}))", f"({a}) % -2.5", f"({a}) // 0.75", f"({a}) ** {few}",
            f"(1.0 + abs({a})) ** -{few}", f"abs({a}) ** 1.5", f"(0.5 + abs({a})) ** 0.5", f"(-({a}))", f"(+({a}))",
            f"min({a}, {b})", f"max({a}, {b}, {whole})", f"abs({a})", f"({a} if {truth} else {b})",
            f"({a}, {b}, 2.0)[{self._choose(3)}]", f"(float({a}), float({whole}))[{whole} % 2]", f"(({a}) - {truth})",
            self.one(SMOOTH).format(a), self.one(SMOOTH).format(a), f"(({a}) * 2.0 + 0.5)",
        ]  # fmt: skip
        if self.helpers:
            options += [f"mixed({whole}, {a})", f"mixed({a}, {b})", f"closed({a}, {whole})", f"total({self.vector()})"]
        return self.one(options)

    def truth(self, depth: int) -> str:
        if depth == 0:
            return self.one([*self.truths, "True", f"({self.whole(0)[0]} < {self.whole(0)[0]})"])
        a, b, c = self.real(depth - 1), self.real(depth - 1), self.real(depth - 1)
        i, j = self.whole(depth - 1)[0], self.whole(depth - 1)[0]
        p, q = self.truth(depth - 1), self.truth(depth - 1)
        order = self.one(("<", "<=", ">", ">=", "==", "!="))
        return self.one([
            f"({a} {order} {b})", f"({i} {order} {j})", f"({a} {order} {i})", f"({p} and {q})", f"({p} or {q})",
            f"(not {p})", f"({a} < {b} <= {c})", f"(0 <= {i} {order} {j})", f"({p} if {q} else {i} > 2)",
            f"({p} and {i} > 0 or {q})", f"(N > {self._choose(6)})",
        ])  # fmt: skip

    # Statements.

    def block(self, count: int, depth: int) -> None:
        self.indent += 1
        for _ in range(count):
            self.statement(depth)
        self.indent -= 1

    def statement(self, depth: int) -> None:
        kinds = [self.assign, self.assign, self.assign, self.write, self.write, self.several]
        if depth:
            kinds += [self.branch, self.branch, self.loop, self.loop, self.repeat]
        if self.loops:
            kinds += [self.leave]
        if self.returns is not None and depth < 2:
            kinds += [self.finish]
        if self.helpers:
            kinds += [self.call]
        self.one(kinds)(depth)

    def bounded(self, depth: int) -> str:
        """A float expression that stays small, in loops too."""
        text = self.real(depth)
        return f"max(min({text}, 8.0), -8.0)" if self.loops or self.often() else text

    def assign(self, depth: int) -> None:
        kind = self.one([kind for kind in ("real", "real", "whole", "truth") if self.assigned[kind]])
        name = self.one(self.assigned[kind])
        if kind == "truth":
            self.line(f"{name} = {self.truth(2)}")
        elif kind == "whole":
            if self.often(3):
                self.line(f"{name} = {self.small(2)}")
            else:
                self.line(f"{name} {self.one(('+', '-'))}= {self.one(('1', '2', 'N'))}")
                self.line(f"{name} %= 50")
        elif self.often():
            self.line(f"{name} = {self.bounded(3)}")
        else:
            self.line(f"{name} {self.one(('+', '-'))}= {self.bounded(2)}")
            if self.loops:
                self.line(f"{name} = min(abs({name}), 8.0)")

    def write(self, depth: int) -> None:
        if self.often():
            self.line(f"{self.entry()} = {self.bounded(3)}")
            return
        place, operator = self.entry(), self.one(("+", "-", "*", "/"))
        number = f"(1.0 + abs({self.real(1)}))" if operator == "/" else f"max(min({self.real(2)}, 1.0), -1.0)"
        self.line(f"{place} {operator}= {number}")

    def several(self, depth: int) -> None:
        """An assignment to several names: a swap, a tuple, a chain, or an alias of an array."""
        reals, kind = self.assigned["real"], self._choose(4)
        if kind == 0 and len(reals) > 1:
            self.line(f"{reals[0]}, {reals[1]} = {self.one(((reals[1], reals[0]), (reals[0], self.bounded(2))))[0]}, "
                      f"{self.bounded(2)}")  # fmt: skip
        elif kind == 1:
            place = f"{self.vector()}[{self._choose(COLUMNS)}]"
            self.line(f"{self.one(reals)} = {place} = {self.bounded(2)}")
        elif kind == 2:
            a, b = self.entry(), self.entry()
            self.line(f"{a}, {b} = {b}, {a}")
        elif "piece" in self.vectors:
            self.line(f"piece = {self.vector()} if {self.truth(1)} else {self.vector()}")
            self.line(f"both = {self.one(('parted', 'Limits'))}({self.vector()}, {self.bounded(1)})")
        else:
            self.line("pass")

    def branch(self, depth: int) -> None:
        if not self.often(6):  # a branch that is not taken may be anything
            self.line(f"if N < {self._choose(3)}:")
            self.indent += 1
            self.line("nowhere(nothing)")
            self.indent -= 1
        else:
            self.line(f"if {self.truth(2)}:")
            self.block(1 + self._choose(2), depth - 1)
        if not self.often(3):
            self.line(f"elif {self.truth(1)}:")
            self.block(1, depth - 1)
        if self.often():
            self.line("else:")
            self.block(1 + self._choose(2), depth - 1)

    def loop(self, depth: int) -> None:
        name = f"i{len(self.loops)}"
        start, stop = self._choose(4), self._choose(5)
        ranges = [f"{stop}", f"{start}, {stop + 1}", f"N - 1, {start - 2}, -1", f"0, {stop + 2}, 2", "M",
                  f"{start + 2}, -{start}, -2", f"abs({self.whole(0)[0]}) % 4"]  # fmt: skip
        self.line(f"for {name} in range({self.one(ranges)}):")
        self.loops.append("for")
        self.block(1 + self._choose(3), depth - 1)
        self.loops.pop()

    def repeat(self, depth: int) -> None:
        """A while loop, with a counter of its own."""
        name = f"n{len(self.loops)}"
        self.line(f"{name} = {6 - self._choose(6)}")
        self.line(f"while {self.one([f'{name} > 0', f'{name} > 0 and {self.truth(1)}', 'True', f'{name}'])}:")
        self.indent += 1
        self.line(f"{name} -= 1")
        self.line(f"if {name} <= 0:")
        self.line("    break")
        self.indent -= 1
        self.loops.append("while")
        self.block(1 + self._choose(2), depth - 1)
        self.loops.pop()

    def leave(self, depth: int) -> None:
        self.line(f"if {self.truth(2)}:")
        self.line(f"    {self.one(('break', 'continue'))}")

    def finish(self, depth: int) -> None:
        assert self.returns is not None
        self.line(f"if {self.truth(2)}:")
        self.line(f"    return {self.returns()}")

    def call(self, depth: int) -> None:
        kind = self._choose(3)
        if kind == 0:
            self.line(f"blend({self.vector()}, {self.vector()}, {self.bounded(1)})")
        elif kind == 1:
            self.line(f"s0, k0, b0 = parts({self.vector()}, {self.small(1)})")
        else:
            self.line(f"s1 = total(parted({self.vector()}, {self.bounded(1)}).low)")


HEADER = "from lqrsim.kernels.records import Limits\n"


def program(choose: Choose) -> str:
    """The text of helpers and of `main(n, k, flag, a, b, x, m, c, pair, law, book)`, which writes to its arrays."""
    return "\n".join([HEADER, *_helpers(choose), *_main(choose)]) + "\n"


def _number_helper(choose: Choose, name: str, returns: str) -> list[str]:
    writer = Writer(choose)
    writer.reals, writer.vectors = ["p", "q", "t"], []
    writer.entry = lambda: "t"
    writer.assigned["real"] = ["t"]
    writer.lines = [f"def {name}(p, q):", "    t = 0"]
    writer.line(f"if p > q:\n        t = {writer.one(('p', 'q + 1', 'p * 0.5'))}")
    for _ in range(choose(3)):
        writer.assign(0)
    writer.line(f"return {returns.format(writer.real(1))}")
    return writer.lines


def _helpers(choose: Choose) -> list[str]:
    """Functions that are called with ints and floats, return one number or several, and write to arrays."""
    vectors = Writer(choose)
    vectors.reals, vectors.wholes, vectors.vectors = ["f", "v[0]", "w[2]"], ["1", "N"], ["v", "w"]
    vectors.assigned["real"] = ["f"]
    vectors.lines = ["def blend(v, w, f):"]
    vectors.loop(1)
    vectors.write(0)
    sums = [
        "def total(v):", "    s = 0", "    for i in range(N):", "        s += v[i]", "    return s / 4",
        "def parts(v, i):", "    if i > 2:", "        return v[0], i, True", "    return 1, i - 1, v[1] > v[2]",
        "def closed(p, q):", "    return (p * 3 - q) % 11",
        "def parted(v, f):", "    v[0] = max(min(v[0] + f, 8.0), -8.0)", "    return Limits(v, f)",
    ]  # fmt: skip
    return [*_number_helper(choose, "mixed", "max(min({}, 20.0), -20.0)"), *sums, *vectors.lines]


def _main(choose: Choose) -> list[str]:
    writer = Writer(choose)
    writer.lines = ["def main(n, k, flag, a, b, x, m, c, pair, law, book):"]
    writer.line("work = stack(N)")
    writer.line("for i in range(N):\n        work[i] = 0.5 * i")
    writer.line("deep = stack(M, N)")
    writer.line("for i in range(M):\n        for j in range(N):\n            deep[i, j] = i - j")
    writer.line("s0 = 1.5\n    s1 = s2 = 0\n    k0, k1, b0 = 2, n, not flag")
    writer.line("i0 = i1 = i2 = i\n    piece, both = x, Limits(work, s0)")
    writer.reals = ["a", "b", "s0", "s1", "s2", "both.high", "law.high[0]", "pair[1][2]"]
    writer.wholes, writer.truths = ["n", "k", "k0", "k1", "i0", "i1", "N", "M"], ["flag", "b0", "(k0 > n)"]
    writer.vectors = ["x", "work", "piece", "pair[n % 2]", "law.low", "both.low"]
    writer.matrices, writer.blocks = ["m", "deep"], ["c"]
    writer.rows, writer.helpers = "book", True
    writer.assigned = {"real": ["s0", "s1", "s2"], "whole": ["k0", "k1"], "truth": ["b0"]}
    returned = [
        lambda: writer.real(2), lambda: writer.small(2), lambda: writer.truth(2),
        lambda: f"{writer.real(1)}, {writer.small(1)}, {writer.truth(1)}", None,
    ]  # fmt: skip
    writer.returns = writer.one(returned)
    for _ in range(3 + choose(8)):
        writer.statement(3)
    for i in range(3):
        writer.line(f"c[1, {i}, 0] += {('s0', 's1', 's2 + k0 + k1 + i0 + i1 + both.high')[i]}")
    if writer.returns is not None:
        writer.line(f"return {writer.returns()}")
    return writer.lines


def _of_choices(choices: bytes) -> str:
    left = iter(choices)
    return program(lambda count: next(left, 0) % count)


# Bytes are drawn at once, which takes little time, and shrink to short and simple programs.
programs = st.binary(min_size=1500, max_size=5000).map(_of_choices)


def arguments(seed: int) -> list[Any]:
    """Arguments for a program. Most floats are multiples of 1/8, whose sums and products are exact."""
    rng = np.random.default_rng(seed)

    def some(*shape: int) -> Array:
        return np.where(rng.random(shape) < 0.15, rng.normal(size=shape), rng.integers(-32, 33, size=shape) / 8)

    book = np.zeros(ROWS, [(name, np.float64) for name in FIELDS])
    for name in FIELDS:
        book[name] = some(ROWS)
    (n, k), flag, (a, b) = rng.integers(-9, 10, size=2).tolist(), bool(rng.integers(2)), some(2).tolist()
    arrays = some(COLUMNS), some(ROWS, COLUMNS), some(PLANES, ROWS, COLUMNS)
    return [n, k, flag, a, b, *arrays, (some(COLUMNS), some(COLUMNS)), Limits(some(COLUMNS), some(COLUMNS)), book]


def for_python(given: list[Any]) -> list[Any]:
    """The same arguments with rows whose fields have names in Python."""
    return [*given[:-1], given[-1].view(np.recarray)]


def on_tracked(given: list[Any]) -> list[Any]:
    """The same arguments with numbers that track their error."""

    def objects(array: Array) -> Any:
        found = np.empty(array.shape, dtype=object)
        for place in np.ndindex(array.shape):
            found[place] = tracked(array[place])
        return found

    *numbers, x, m, c, pair, law, book = given
    rows = [SimpleNamespace(**{name: tracked(row[name]) for name in FIELDS}) for row in book]
    numbers = [tracked(one) if isinstance(one, float) else one for one in numbers]
    return [*numbers, *map(objects, (x, m, c)), tuple(map(objects, pair)), Limits(*map(objects, law)), rows]


def numbers_in(given: Any) -> list[Any]:
    """All numbers in these values, in order."""
    if given is None:
        return []
    if isinstance(given, SimpleNamespace):
        return [getattr(given, name) for name in FIELDS]
    if isinstance(given, np.ndarray) and given.dtype.names:
        return [row[name] for row in given for name in FIELDS]
    if isinstance(given, tuple | list):
        return [number for one in given for number in numbers_in(one)]
    return list(given.ravel()) if isinstance(given, np.ndarray) else [given]
