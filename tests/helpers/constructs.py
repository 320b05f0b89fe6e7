"""Short functions: what the kernels' language contains, and what it refuses."""

import re

# Each construct by itself: the pairs of i and j that a function is called with, and its body.
_CONSTRUCTS = """\
## floor division of ints: (7, 2), (-7, 2), (7, -2), (-7, -2), (6, -3), (-6, 3), (0, -5)
return i // j, i % j

## floor division of floats: (7.5, 2.0), (-7.5, 2.0), (7.5, -2.0), (-7.5, -2.0), (6.0, -3.0), (5, -2.5), (-5.0, 2)
return i // j, i % j

## division by an infinite float: (5.0, INF), (-5.0, INF), (5.0, -INF), (-5.0, -INF)
return i // j, i % j

## division of ints: (7, 2), (-7, 2), (1, 3)
return i / j

## bools as ints: (1, 2), (-1, 0), (3, 2)
return (i > 0) + (j > 0) * 2 - (i > j), -(i > 0), +(j > 0)

## bools as floats: (1, 2), (-1, 0)
return 0.5 + (i > 0), (i > 0) / 2, abs(i > 0), float(i > j)

## comparisons: (1, 2), (2, 2), (-0.0, 0.0), (1, 1.5), (NAN, NAN), (NAN, 1.0), (INF, INF), (-INF, INF), (True, 1)
return i < j, i <= j, i > j, i >= j, i == j, i != j

## not of comparisons: (1.0, 2.0), (NAN, 1.0), (2, 2)
return not i < j, not i >= j, not i == j

## chained comparisons: (1, 2), (2, 1), (0, 4), (3, 5), (1.0, NAN), (1, 1)
return 0 < i <= j < 5, i < 2 > j

## and, or, not: (1, 1), (1, -1), (-1, 1), (-1, -1), (7, 7)
return i > 0 and j > 0, i > 0 or j > 0, not (i > 0 and j > 0) or i == 7

## ints as conditions: (0, 0), (0, 3), (-2, 0), (5, 5)
k = 1 if i else 2
if i and j:
    k += 10
if not j or i:
    k += 100
return k

## conditional expressions: (1, 2), (2, 1), (1.5, 0.5)
return i if i > j else j, (1 if i > j else 2.5)

## conditional expressions in each other: (-4, -2), (-4, 3), (-4, 6), (2, -2), (2, 3), (2, 6), (5, -2), (5, 3), (5, 6)
return (1 if i > 3 else 2) if (i > j if j > 0 else i < j) else (3 if i > 0 or j > 5 else 4)

## min and max: (1, 2), (2, 1), (1.5, -3.0), (NAN, 1.0), (1.0, NAN), (INF, -INF), (NAN, NAN), (2, 2.5)
return min(i, j), max(i, j), min(i, j, 1), max(j, i, 0.5)

## abs: (-3, 3), (-2.5, 2.5), (-INF, 0.0), (NAN, -1e-300), (0, -1)
return abs(i), abs(j)

## int and float: (2.7, -2.7), (0.999, -0.999), (-5, 1e15), (2, True)
return int(i), int(j), float(i)

## loops: (4, 2), (0, 3), (-1, 2), (3, 6)
k = 0
for n in range(i):
    k = 10 * k + n
for n in range(i, j):
    k = 3 * k + n
return k

## loops by steps: (1, 8), (0, 0), (8, 1), (2, 3)
k = 0
for n in range(i, j, 2):
    k = 10 * k + n
for n in range(j, i, -3):
    k = 10 * k - n
for n in range(4, 4, -1):
    k = 0
return k

## the bounds of a loop are looked at once: (3, 0), (0, 0)
k = 0
for n in range(i):
    i = 0
    n = n + 5
    k += n
return k, i

## loop variables after the loop: (5, 2), (5, 9), (0, 1)
n = -1
for n in range(i):
    if n == j:
        break
return n, i

## loop variables that become floats: (3, 2), (0, 4)
n = 0
for n in range(i):
    n = n + 0.5
return n * j

## while, break and continue: (6, 2), (5, 8), (0, 0), (9, 4)
k = 0
while i > 0:
    i -= 1
    if i == j:
        continue
    if i * 2 == j:
        break
    k += i
return k, i

## loops in each other: (5, 2), (6, 0), (0, 0), (4, 9)
k = 0
for n in range(i):
    for m in range(n, -1, -1):
        if m == j:
            break
        k += m
    while True:
        k += 1
        if k % 3 == 0:
            break
    if n == 3:
        continue
    k += 7
return k

## a loop that only a return ends: (0, 50), (9, 3)
while True:
    i += 1
    if i * i > j:
        return i

## early returns: (2, 1), (3, 3), (1, 5), (20, 30)
if i > j:
    return 1, 2.5
elif i == j:
    return i, j
for n in range(9):
    if n > i:
        return n, -1.5
return 0, 0.0

## int variables that become floats: (2, 0), (2.5, 0)
k = 0
for n in range(3):
    k = k + i
m = k / 2
return k, m, k // 2

## what is returned becomes a float: (2, 1), (1, 2)
if i > j:
    return i
return 0.5

## swaps: (1, 2), (1.5, 2.5)
i, j = j, i
i, j, k = j, i + 1, i
return i, j, k

## chained assignment: (1, 2)
k = n = i
k += 1
m = (a, b) = (i, j)
return k, n, m[1], a, b

## augmented assignment: (4, 3), (1.5, -2.5)
i += j
i -= 3
i *= j
k = i
k //= 2
m = i
m %= 5
n = i
n /= 4
p = i
p **= 2
return i, k, m, n, p

## tuples: (1, 2), (1.5, 2)
t = (i, j, i + j)
s = (t, (1, 2))
a, (b, c) = t[0], s[1]
return t[2], s[0][1], a, b, c, len(t), len(s)

## tuples indexed while running: (1, 2), (4, 3)
k = 0
for n in range(3):
    k = 10 * k + (i, j, 7)[n]
return k, (1.5, 2.5)[i > j], ((1, 2), (3, 4))[1][i % 2]

## annotations and docstrings: (2, 0)
'What it does.'
k: float = 2
k += 1
pass
return k * i

## powers: (3, 0), (-2, 0), (1.5, 0), (0, 0)
return i ** 2, i ** 3, i ** 1, i ** 0, i ** 7, (-i) ** 3, -i ** 2

## negative powers: (2, 0), (-4, 0), (0.5, 0), (-1.5, 0)
return i ** -1, i ** -2, i ** -5

## large powers: (3, 1.01), (-2, 0.97)
return i ** 30, j ** 64, j ** 65, j ** 200, j ** -100

## powers of floats: (2.0, 3.0), (0.25, -1.5), (7.5, 0.0), (9.0, 3)
return i ** 0.5, i ** j, i ** -0.5, 2.0 ** j, i ** 2.0

## powers of constants: (1, 0)
return 2 ** 10 + i, 2 ** -2, 10.0 ** -3, 2.0 ** 100, (-3) ** 3, 3 ** 0

## a power by an int that is known late: (3, 2), (-3, 4), (0, 9)
return 1.5 ** i, 2.0 ** (j - 4)

## constants: (0, 0)
return 1e3, 1_000, 0x10, True, 1.5e-300, -0.0, 1 / 3 + i

## conditions that are constant: (1, 0)
if 2 > 3:
    i = nowhere(nothing)
elif not 1:
    i = [1, 2]
else:
    i += 1
while False:
    nowhere()
k = i if True else 'text'
if 1 < 2 or nowhere():
    k += 1
if 0 and nowhere():
    k += nowhere()
return k

## what comes after a return: (1, 0)
return i
nowhere(nothing)
"""

SIGNATURE = "def f(a, i, x, m, pair, law, log):"

# What the message says of each: "got" that; and below, of more than one line. It is about the line with a `#`, or else
# the first one, or about the function as a whole.
_LINES = """\
import math  ->  `import math`
from math import sin  ->  `from math import sin`
nonlocal a2  ->  `nonlocal a2`
del a  ->  `del a`
assert a > 0  ->  `assert a > 0`
raise ValueError  ->  `raise ValueError`
yield a  ->  an expression that is not used
b = yield a  ->  `(yield a)`
a + 1  ->  an expression that is not used
...  ->  an expression that is not used
b: float  ->  a name without a value
break  ->  `break` outside of a loop
return a + nothing  ->  the name nothing, which is not defined
return nothing(a)  ->  a call of nothing
print(a)  ->  a call of print
return np.sin(a)  ->  `np.sin(a)`
return x.sum()  ->  `x.sum()`
return pair.index(x)  ->  `pair.index(x)`
return sin(a)(a)  ->  `sin(a)(a)`
b = sin  ->  the function sin as a value
b = f  ->  the function f as a value
N += 1  ->  the name N, which has no value yet
a = x  ->  an array of 1 dimensions for a, which is a float
x = 1.0  ->  a float for x, which is an array of 1 dimensions
x = m  ->  an array of 2 dimensions for x, which is an array of 1 dimensions
law = (x, x)  ->  a tuple for law, which is a Limits
b = a if i > 0 else x  ->  a float or an array of 1 dimensions
b, c = a  ->  a float for 2 names
b, c = x  ->  an array of 1 dimensions for 2 names
b, c = (1, 2, 3)  ->  a tuple for 2 names
() = a  ->  a float for 0 names
b, *c = (1, 2)  ->  `*c` assigned to
[b, c] = (1, 2)  ->  `[b, c]` assigned to
law.low = x  ->  `law.low` assigned to
m[0] = x  ->  `m[0]` assigned to
m[0] += 1  ->  `m[0]` assigned to
log[0] = 1.0  ->  `log[0]` assigned to
x[0] = x  ->  an array of 1 dimensions, want a number
x[0] += x  ->  an array of 1 dimensions, want a number
return law.middle  ->  .middle of a Limits
return log[0].nothing  ->  .nothing of a struct
log[0].nothing = 1.0  ->  `log[0].nothing` assigned to
return log.cost  ->  .cost of a structured array
return x.size  ->  .size of an array of 1 dimensions
return a.real  ->  .real of a float
return (a, a).low  ->  .low of a tuple
return law._fields  ->  ._fields of a Limits
b = [1, 2]  ->  `[1, 2]`
b = {1: 2}  ->  `{1: 2}`
b = {1, 2}  ->  `{1, 2}`
b = 'text'  ->  `'text'`
b = f'{a}'  ->  `f'{a}'`
b = b'text'  ->  `b'text'`
b = None  ->  `None`
b = a + 1j  ->  `1j`
b = lambda c: c  ->  `lambda c: c`
b = [c for c in (1, 2)]  ->  `[c for c in (1, 2)]`
b = sum(c for c in (1, 2))  ->  `(c for c in (1, 2))`
b = (c := a)  ->  `(c := a)`
return hypot(*pair)  ->  `*pair`
return min(a, key=a)  ->  `min(a, key=a)`
return x[0:2]  ->  `0:2`
return a is a  ->  `a is a`
return a in (1.0, 2.0)  ->  `a in (1.0, 2.0)`
return a not in (1.0, 2.0)  ->  `a not in (1.0, 2.0)`
return i & 1  ->  `i & 1`
return i | 1  ->  `i | 1`
return i ^ 1  ->  `i ^ 1`
return ~i  ->  `~i`
i <<= 2  ->  `i <<= 2`
return x @ x  ->  `x @ x`
return x + 1  ->  an array of 1 dimensions, want a number
b = -x  ->  an array of 1 dimensions, want an int
b = +x  ->  an array of 1 dimensions, want an int
return x < 1  ->  an array of 1 dimensions, want a number
b = (1, 2) + (3,)  ->  a tuple, want a number
b = (1, 2) * 2  ->  a tuple, want a number
return (1, 2) < (1, 3)  ->  a tuple, want a number
return (1, 2) < 3  ->  a tuple, want a number
return min((1, 2), 3)  ->  a tuple and an int, want numbers
return log[0] + 1  ->  a struct, want a number
b = not a  ->  a float as a condition
b = i and 2  ->  an int as a value of `i and 2`
b = a or 1.0  ->  a float as a value of `a or 1.0`
return x[a]  ->  a float, want an int
return x[1.0]  ->  a float, want an int
return x[i > 0]  ->  `x[i > 0]`
return x[-1]  ->  a negative index
return m[0, -2]  ->  a negative index
return (a, a)[-1]  ->  a negative index
return x[0, 1]  ->  2 indices of an array of 1 dimensions
return m[0, 1, 2]  ->  3 indices of an array of 2 dimensions
return x[0][1]  ->  1 indices of a float
return x[()]  ->  `x[()]`
return x[...]  ->  `...`
return a[0]  ->  1 indices of a float
return log[0, 1]  ->  2 indices of a structured array
return pair[0, 1]  ->  2 indices of a tuple of vectors
return (a, a)[2]  ->  entry 2 of 2
return (a, i)[i]  ->  an index that is not constant, of a tuple of several types
return ((a, a), (a, a))[i][0]  ->  an index that is not constant, of a tuple of several
return i + 9223372036854775808  ->  an int of more than 64 bits
return 2 ** 62 * 2  ->  an int of more than 64 bits
return 3 ** 60  ->  an int of more than 64 bits
return 10 ** 1000000000  ->  a whole exponent of an int
return i ** i  ->  a whole exponent of an int that is not constant
return i ** 65  ->  a whole exponent of an int that is not constant
return min(a)  ->  1 arguments in `min(a)`
return abs(a, a)  ->  2 arguments in `abs(a, a)`
return abs(x)  ->  an array of 1 dimensions, want a number
return sin(a, a)  ->  2 arguments in `sin(a, a)`
return pow(i, 2, 3)  ->  3 arguments in `pow(i, 2, 3)`
return sin(x)  ->  an array of 1 dimensions, want a number
return isnan(x)  ->  an array of 1 dimensions, want a number
return int(x)  ->  an array of 1 dimensions, want an int
return len(x)  ->  the length of an array of 1 dimensions
return len(pair)  ->  the length of a tuple of vectors
b = range(3)  ->  a call of range
inline(a)  ->  a call of inline
return round(a)  ->  a call of round
return sum(x)  ->  a call of sum
b = Limits(x)  ->  1 fields of Limits
b = stack(i)  ->  `stack(i)`
b = stack(2.0)  ->  `stack(2.0)`
b = stack(-1)  ->  `stack(-1)`
b = stack()  ->  0 arguments in `stack()`
b = stack(2 ** 40)  ->  `stack(2 ** 40)`
b = stack(2 ** 62, 2 ** 62)  ->  `stack(2 ** 62, 2 ** 62)`
b = rows_at(i, i)  ->  a width that is not constant
b = rows_at(i, 0)  ->  a width that is not constant
b = at(x)  ->  an array of 1 dimensions, want an address
return int32(i) + 1  ->  a 32-bit int, want a number
call()  ->  0 arguments in `call()`
b = call(i)  ->  `call(i)`, which returns nothing
return store(i, 0, 1)  ->  `store(i, 0, 1)`, which returns nothing
store(i, 0, a)  ->  a float, want an int
return a, (a, a)  ->  a tuple of tuples
return ()  ->  an empty tuple
return stack(3)  ->  a work array returned
"""
_REFUSED = """\
## try: `try:`
try:
    a = 1
except ValueError:
    pass

## with: `with a:`
with a:
    pass

## global: `global a2`
global a2
a2 = 1.0

## match: `match i:`
match i:
    case 1:
        pass

## function inside: `def g(b):`
def g(b):
    return b
return g(a)

## class: `class A:`
class A:
    pass

## else after for: `for n in range(3):`
for n in range(3):
    a += 1
else:
    a = 0

## else after while: an else after a loop
while a < 3:
    a += 1
else:
    a = 0

## loop over an array: `for b in x:`
for b in x:
    a += b

## loop over a tuple: `for b in (1, 2):`
for b in (1, 2):
    a += b

## loop of two names: `for n, k in range(3):`
for n, k in range(3):
    pass

## loop without an end: `for n in range():`
for n in range():
    pass

## loop of four: `for n in range(1, 2, 3, 4):`
for n in range(1, 2, 3, 4):
    pass

## loop by keyword: `for n in range(0, stop=3):`
for n in range(0, stop=3):
    pass

## range from a float: a float, want an int
for n in range(a):
    pass

## range from an array: an array of 1 dimensions, want an int
for n in range(x):
    pass

## step that is not constant: a step that is not constant
for n in range(0, 3, i):
    pass

## step of zero: a step that is not constant
for n in range(0, 3, 0):
    pass

## continue outside: `continue` outside of a loop
if a > 0:
    continue  #

## a name that has no value yet: the name b, which has no value yet
for n in range(3):
    a = b  #
    b = 2.0

## a constant that is assigned later: the name pi, which has no value yet
a = pi
pi = 3

## a function that is a name here: a call of sin
sin = 2.0
return sin(a)  #

## tuple of another length: a tuple for b, which is a tuple
b = (1, 2)
b = (1, 2, 3)  #

## entry of a tuple assigned: `b[0]` assigned to
b = (a, a)
b[0] = 1.0  #

## float as a condition: a float as a condition
if a:
    i = 1

## array as a condition: an array of 1 dimensions as a condition
while x:
    i = 1

## float in and: a float as a condition
if i > 0 and a:
    i = 1

## a path without a value: function: a path that returns nothing
if a > 0:
    return a

## a bare return: function: a path that returns nothing
if a > 0:
    return a
return

## a bare return first: function: a path that returns nothing
if a > 0:
    return
return a

## a loop that may end: function: a path that returns nothing
while a > 0:
    return a

## other kinds: an array of 1 dimensions, want a float
if a > 0:
    return a
return x  #

## tuples of other lengths: a tuple, want a tuple
if a > 0:
    return a, a
return a, a, a  #

## an array: function: an array of 1 dimensions returned
return x

## a 32-bit int: function: a 32-bit int returned
return int32(i)

## a work array: a work array returned
b = stack(3)
return b  #

## a block of a work array: a work array returned
b, c = stack(3, 4), x
return a, b[1]  #

## a record with a work array: a work array returned
b = Limits(x, stack(3))
c = b
return c  #
"""

# Whole texts; the line that the message names, and what it got.
_TEXTS = """\
## direct recursion: f, line 1: got a function that calls itself
def f(a):
    return f(a - 1)

## recursion by another type: f, line 1: got a function that calls itself
def f(a):
    return f(a > 1)

## mutual recursion: g, line 1: got a function that calls itself
def g(a):
    return h(a)

def h(a):
    return g(a)

def f(a):
    return g(a)

## recursion with ever larger tuples: g, line 1: got a function that calls itself
def g(a):
    return h((a, a))

def h(a):
    return g(a)

def f(a):
    return g(a)

## default argument: f, line 1: got arguments with defaults
def f(a, b=1):
    return a

## starred arguments: f, line 1: got arguments with defaults
def f(*a):
    return 1.0

## keyword-only argument: f, line 1: got arguments with defaults
def f(a, *, b):
    return a

## positional-only argument: f, line 1: got arguments with defaults
def f(a, /):
    return a

## a default in a helper: g, line 1: got arguments
def g(a, b=1):
    return a

def f(a):
    return g(a, a)

## another number of arguments: f, line 1: got 1 arguments, want 2
def f(a, b):
    return a

## too few for a helper: f, line 5: got 1 arguments for g
def g(a, b):
    return a

def f(a):
    return g(a)

## a helper without a value: f, line 5: got `g(a)`, which
def g(a):
    pass

def f(a):
    return g(a)

## a helper that is wrong: g, line 2: got `[a]`
def g(a):
    return [a]

def f(a):
    return g(a)

## decorator: f, line 2: got `@cache`
@cache
def f(a):
    return a

## decorator with arguments: f, line 2: got `@inline(1)`
@inline(1)
def f(a):
    return a

## coroutine: got no function f
async def f(a):
    return a

## no function: got no function f
def g(a):
    return a

## a name of the module: f, line 4: got the name G
G = 9.81

def f(a):
    return G * a

## a module: f, line 4: got `math.sin(a)`
import math

def f(a):
    return math.sin(a)

## what another module has: f, line 4: got a call of getpid
from os import getpid

def f(a):
    return getpid()

## a module that is not there: f, line 4: got a call of g
from nowhere import g

def f(a):
    return g(a)

## what math has not: f, line 4: got a call of comb
from math import comb

def f(a):
    return comb(a)

## no Python: which is not valid Python
def f(a:
    return a
"""


def _blocks(text: str) -> dict[str, tuple[str, str]]:
    """Each block's message and lines, by its name."""
    parted = (one.partition("\n") for one in re.split("(?m)^## ", text)[1:])
    named = ((*head.split(": ", 1), body.rstrip()) for head, _, body in parted)
    return {name: (said, body) for name, said, body in named}


CONSTRUCTS, REFUSED_TEXTS = _blocks(_CONSTRUCTS), _blocks(_TEXTS)
_lines = (line.split("  ->  ") for line in _LINES.splitlines())
REFUSED = {body: (got, body) for body, got in _lines} | _blocks(_REFUSED)
