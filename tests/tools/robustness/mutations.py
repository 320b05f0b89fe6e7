"""Ways to spoil a file: its bytes, the archive around its arrays, the arrays, and the JSON text beside them."""

import hashlib
import io
import json
import pickle
import struct
import warnings
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Arrays = dict[str, npt.NDArray[Any]]
Rng = np.random.Generator


def pick(rng: Rng, options: Any) -> Any:
    """One of them, as it is."""
    options = list(options)
    return options[int(rng.integers(len(options)))]


# Bytes of any file.


def spoil_bytes(rng: Rng, data: bytes, other: bytes) -> tuple[str, bytes]:
    """Flipped, cut, moved, repeated or foreign bytes; `other` is another file to take some from."""
    spoilt, how = (
        bytearray(data),
        pick(rng, ("bit", "bit", "bit", "headers", "field", "cut", "slice", "insert", "splice", "fill")),
    )
    place = int(rng.integers(len(data)))
    length = int(min(len(data) - place, 2 ** rng.integers(0, 14)))
    if how == "bit":
        for at in rng.integers(len(data), size=pick(rng, (1, 1, 1, 2, 8))):
            spoilt[at] ^= 1 << int(rng.integers(8))
    elif how in ("headers", "field"):
        signatures = [at for sign in (b"PK\1\2", b"PK\3\4", b"PK\5\6", b"\x93NUMPY") for at in _all(data, sign)]
        at = min(pick(rng, signatures or [place]) + int(rng.integers(60)), len(data) - 4)
        if how == "headers":
            spoilt[at] ^= 1 << int(rng.integers(8))
        else:
            value = pick(rng, (0, 1, 0x7FFFFFFF, 0xFFFFFFFF, int(rng.integers(1 << 32))))
            spoilt[at : at + 4] = struct.pack("<I", value)
    elif how == "cut":
        del spoilt[place:]
    elif how == "slice":
        del spoilt[place : place + length]
    elif how == "insert":
        spoilt[place:place] = rng.bytes(length)
    elif how == "splice":
        spoilt[place:] = other[place:]
    else:
        spoilt[place : place + length] = bytes([pick(rng, (0, 255, 32))]) * length
    return f"bytes: {how}", bytes(spoilt)


def _all(data: bytes, sign: bytes) -> list[int]:
    found, at = [], data.find(sign)
    while at >= 0:
        found.append(at)
        at = data.find(sign, at + 1)
    return found


# The archive, and its members.


def member(array: npt.NDArray[Any]) -> bytes:
    """An array as NumPy writes it, pickled where it has objects."""
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=True)
    return file.getvalue()


def archive(members: list[tuple[str, bytes]], packing: int = zipfile.ZIP_DEFLATED, comment: bytes = b"") -> bytes:
    """A zip file of these, in this order; names may come twice."""
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as written:
        warnings.simplefilter("ignore")  # of names that come twice
        for name, contents in members:
            written.writestr(zipfile.ZipInfo(name), contents, packing)
        written.comment = comment
    return file.getvalue()


def seal(arrays: Arrays, meta: Any) -> str:
    """The hash that docs/file_format.md describes."""
    text = json.dumps({k: v for k, v in meta.items() if k != "sha256"}, sort_keys=True, separators=(",", ":"))
    found = hashlib.sha256(text.encode())
    for name, array in sorted(arrays.items()):
        found.update(f"\n{name} {array.dtype.str} {array.shape}\n".encode() + array.tobytes())
    return found.hexdigest()


def spoil_members(rng: Rng, arrays: Arrays, meta: dict[str, Any], *, sealed: bool) -> tuple[str, bytes]:
    """Members dropped, renamed, doubled, added, packed otherwise, or with other contents."""
    arrays, name = dict(arrays), pick(rng, arrays)
    how = pick(rng, MEMBERS)
    extra: list[tuple[str, bytes]] = []
    raw: dict[str, bytes] = {}
    packing, comment = zipfile.ZIP_DEFLATED, b""
    if how == "drop":
        del arrays[name]
    elif how == "rename":
        arrays[pick(rng, ("x", name.upper(), f"{name}.0", f" {name}", "", *NAMES))] = arrays.pop(name)
    elif how == "double":
        extra.append((f"{name}.npy", member(pick(rng, (arrays[name], arrays[name] * 0, pick(rng, arrays.values()))))))
    elif how == "double text":
        extra.append(("meta.npy", member(np.array(json.dumps(meta | {"seed": 7})))))
    elif how == "add":
        arrays[pick(rng, NAMES)] = np.zeros(pick(rng, (3, (2, 2), 0, ())))
    elif how == "bomb":
        arrays[pick(rng, ("bomb", name))] = np.zeros(6_000_000)
    elif how == "add bytes":
        extra.append((pick(rng, ("readme.txt", "../x.npy", "/x.npy", "a/", "x", f"{name}", "meta")), rng.bytes(20)))
    elif how == "no array":
        raw[name] = pick(
            rng, (b"", b"\x93NUMPY", rng.bytes(200), member(arrays[name])[:60], b"\x93NUMPY\3\0" + b"\xff" * 8)
        )
    elif how == "pickle":
        raw[name] = pick(rng, (pickle.dumps({}), member(np.array([{}, None], dtype=object)), member(np.array(print))))
    elif how == "header":
        raw[name] = _header(rng, arrays[name])
    elif how == "longer":
        raw[name] = member(arrays[name]) + rng.bytes(int(rng.integers(1, 40)))
    elif how == "packing":
        packing = pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
    elif how == "comment":
        comment = pick(rng, (b"hello", rng.bytes(60000), b"PK\5\6" + bytes(18)))
    elif how == "no text":
        meta = {}
    else:
        with np.errstate(all="ignore"):
            arrays[name] = _other_array(rng, arrays[name], how)
        if arrays[name].dtype.hasobject:
            sealed = False
    if sealed:
        meta = meta | {"sha256": seal(arrays, meta)}
    members = [("meta.npy", member(np.array(json.dumps(meta))))]
    members += [
        (f"{key}.npy", raw.get(key) or member(value)) for key, value in arrays.items() if key not in raw or raw[key]
    ]
    members += [(f"{key}.npy", value) for key, value in raw.items() if not value]
    rng.shuffle(members)  # pyright: ignore[reportArgumentType]
    at = int(rng.integers(len(members) + 1))
    members[at:at] = extra
    return f"members: {how} {name}", archive(members, packing, comment)


MEMBERS = (
    "drop", "rename", "double", "double text", "add", "bomb", "add bytes", "no array", "pickle", "header", "longer",
    "packing", "comment", "no text", "dtype", "dtype", "order", "transpose", "shape", "shape", "slice", "values",
    "values", "values",
)  # fmt: skip
NAMES = (
    "cost_to_go.hessian", "inverse_policy.gain", "multipliers.0", "multipliers.7", "clearance", "candidates.states",
    "frames", "contacts", "unknown", "x" * 300, "über",
)  # fmt: skip


def _other_array(rng: Rng, array: npt.NDArray[Any], how: str) -> npt.NDArray[Any]:
    if how == "dtype":
        kind = pick(
            rng, ("f4", "f2", ">f8", "i8", "i4", "u1", "c16", "?", "M8[s]", "U8", "S8", "O", "V8", "f8,f8", "g")
        )
        try:
            return array.astype(kind)
        except (TypeError, ValueError):
            return np.zeros(array.shape, kind)
    if how == "order":
        return np.asfortranarray(array)
    if how == "transpose":
        return np.ascontiguousarray(np.swapaxes(array, 0, -1)) if array.ndim else array
    if how == "shape":
        shape = [
            array[None],
            array.ravel(),
            array[..., None],
            np.repeat(array, 2, axis=0),
            np.zeros((0, *array.shape[1:])),
        ]
        return pick(rng, [*shape, np.array(1.0), np.zeros((1,) * 20), np.concatenate([array, array], axis=-1)])
    if how == "slice":
        return array[pick(rng, (slice(0), slice(1), slice(1, None), slice(None, -1)))]
    changed = array.copy().reshape(-1)
    if changed.size:
        low, high = sorted(rng.integers(changed.size + 1, size=2))
        places = pick(rng, (slice(None), slice(low, high), int(rng.integers(changed.size))))
        value = pick(rng, (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e308, 1e-308, 1e5, rng.normal()))
        changed[places] = np.nan_to_num(value).clip(-(2**62), 2**62) if changed.dtype.kind == "i" else value
    return changed.reshape(array.shape)


def _header(rng: Rng, array: npt.NDArray[Any]) -> bytes:
    """A member with a hand-made header: shapes that lie, names that are not known, text to choke a parser."""
    shapes = (
        "(99999999999,)",
        "(3,",
        "()",
        "(-1,)",
        "(1e3,)",
        "(" * 3000,
        "(True,)",
        f"({'1, ' * 90})",
        "(1L,)",
        "[2]",
    )
    shape, kind = str(array.shape), array.dtype.str
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    header = pick(
        rng,
        (
            header.replace(shape, pick(rng, shapes)),
            header.replace(shape, pick(rng, shapes)),
            header.replace(kind, pick(rng, ("|O", "<f16", "<q8", "", "<f8<f8", "|S0", "<U0", "<M8[as]"))),
            header.replace("False", pick(rng, ("True", "None", "0", "__import__('os').getcwd()"))),
            header.replace("}", "'more': 1}"),
            "1" + "+1" * 3000, "-" * 5000, "\n \t  x", "{", "'" * 3, "\0" * 20, "é",
        ),
    )  # fmt: skip
    text = header.encode("latin1") + b"\n"
    version = pick(rng, (b"\1\0", b"\1\0", b"\1\0", b"\2\0", b"\3\0", b"\0\0", b"\xff\xff"))
    size = struct.pack("<H" if version[0] < 2 else "<I", pick(rng, (len(text), len(text), len(text), 0xFFFF, 0)))
    return b"\x93NUMPY" + version + size + text + array.tobytes()


# JSON.


def spoil_json(rng: Rng, tree: Any) -> tuple[str, Any]:
    """A copy with one value replaced by one of another type or range, or a name taken out, added or changed."""
    tree = json.loads(json.dumps(tree))
    places = list(_places(tree, ()))
    # Half of the time near the root, where everything that is not a long list has its place.
    near = [place for place in places if len(place) <= 1]
    place = pick(rng, near if rng.random() < 0.5 else places)
    how = pick(rng, ("value", "value", "value", "value", "remove", "rename", "add", "swap"))
    if not place:
        return "json: root", pick(rng, (None, [], 3, "text", [tree]))
    holder = tree
    for step in place[:-1]:
        holder = holder[step]
    last = place[-1]
    if how == "value":
        holder[last] = value = pick(rng, _values(rng, holder[last]))
        return f"json: {'.'.join(map(str, place))} = {repr(value)[:60]}", tree
    if how == "remove":
        del holder[last]
    elif how == "add":
        if isinstance(holder, dict):
            holder[pick(rng, ("more", "", "__class__", "x" * 3000, "a\nb", "\ud800"))] = pick(rng, (None, 1, "x", []))
        else:
            holder.insert(last, holder[last])
    elif how == "rename" and isinstance(holder, dict):
        holder[f"{last}_"] = holder.pop(last)
    else:
        other = pick(rng, list(holder) if isinstance(holder, dict) else range(len(holder)))
        holder[last], holder[other] = holder[other], holder[last]
    return f"json: {how} {'.'.join(map(str, place))}", tree


def _places(tree: Any, at: tuple[Any, ...]) -> Any:
    yield at
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from _places(value, (*at, name))
    elif isinstance(tree, list):
        for number, value in enumerate(tree[:12]):
            yield from _places(value, (*at, number))


def _values(rng: Rng, was: Any) -> list[Any]:
    values: list[Any] = [
        None, True, False, 0, 1, -1, 2, 3.5, 1e-300, 1e30, 1e308, float("nan"), float("inf"), float("-inf"), 10**40,
        10**400, 2**31, 2**63, -(2**63), "", "x", "nan", "a\nb", "\ud800", "\0", "🤖" * 10, "x" * 5000, "<mujoco/>",
        [], {}, [[]], [None], {"a": 1}, [1, 2, 3], ["x", "y", "z"], _nested(50), _nested(5), {"": {"": {}}},
    ]  # fmt: skip
    if isinstance(was, bool | int | float):
        values += [was + 1, was * 2, -was, str(was), [was], was * 1e9]
    if isinstance(was, str):
        low, high = sorted(rng.integers(len(was) + 1, size=2).tolist())
        values += [was[:low] + was[high:]] * 6 + [was[:high] + was[low:], was[:low] + "9" + was[low + 1 :]]
        values += [was.upper(), was + "x", was[:-1], was[::-1], [was], was * 3, f"{was}\n", {was: was}]
    if isinstance(was, list):
        values += [was[::-1], was + was, was[:-1], tuple(was), dict(enumerate(was)), [*was, None]]
    if isinstance(was, dict):
        values += [list(was), list(was.values()), {**was, "more": 1}]
    return [*values, float(rng.normal()), int(rng.integers(1 << 40))]


def _nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def spoil_text(rng: Rng, tree: Any) -> tuple[str, str]:
    """JSON that is spoilt as a text: names twice, nesting without end, what only some parsers take."""
    text = json.dumps(tree)
    name = pick(rng, tree)
    first = f'"{name}": '
    deep = "[" * pick(rng, (100, 1000, 100000)) if rng.random() < 0.5 else '{"a":' * 3000
    options: dict[str, Callable[[], str]] = {
        "double": lambda: text[:-1] + f", {first}1}}",
        "double same": lambda: text[:-1] + f", {first}{json.dumps(tree[name])}}}",
        "deep": lambda: text[:-1] + f', "deep": {deep}',
        "deep whole": lambda: "[" * 5000 + "]" * 5000,
        "deep value": lambda: text.replace(first, f'{first}{"[" * 900 + "]" * 900}, "was": ', 1),
        "digits": lambda: text.replace(first, f'{first}{"9" * 6000}, "was": ', 1),
        "exponent": lambda: text.replace(first, f'{first}1e999, "was": ', 1),
        "trailing": lambda: text + pick(rng, ("x", "{}", " ", "\n", "\0", ",")),
        "mark": lambda: "\ufeff" + text,
        "cut": lambda: text[: int(rng.integers(len(text)))],
        "quotes": lambda: text.replace('"', "'"),
        "comment": lambda: "// hello\n" + text,
        "empty": lambda: pick(rng, ("", " ", "null", "NaN", "-", '"', "[]", "{}")),
        "spaces": lambda: json.dumps(tree, indent=pick(rng, (0, 3))),
    }
    how = pick(rng, options)
    return f"text: {how} {name}", options[how]()
