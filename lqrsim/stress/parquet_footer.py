"""The footer of a parquet file, read without PyArrow, whose own objects of it end the process where it is damaged.

Only what bounds the memory that a file takes is kept. The format is Thrift's compact protocol:
https://github.com/apache/parquet-format and https://github.com/apache/thrift/blob/master/doc/specs.
"""

import io
from typing import Any, NamedTuple

_MAGIC = b"PAR1"
_DEEPEST = 20  # structures within each other; a footer has 7
_BOOLEANS, _BYTE, _INTEGERS, _DOUBLE, _TEXT, _LISTS, _MAP, _STRUCT = (1, 2), 3, (4, 5, 6), 7, 8, (9, 10), 11, 12


class Chunk(NamedTuple):
    """A column of a row group: its codec (0 none, 1 Snappy), number of values, and bytes in the file."""

    codec: int
    values: int
    size: int


def chunks(contents: bytes) -> list[list[Chunk]]:
    """The columns of each row group. Raises an exception of any kind where the footer is damaged."""
    length = int.from_bytes(contents[-8:-4], "little")
    if contents[-4:] != _MAGIC or not 0 < length <= len(contents) - 12:
        raise ValueError("no footer of parquet")
    footer = _struct(io.BytesIO(contents[-8 - length : -8]), _DEEPEST)
    columns = [[chunk[3] for chunk in group[1]] for group in footer[4]]
    return [[Chunk(one[4], one[5], one[7]) for one in group] for group in columns]


def _struct(data: io.BytesIO, depth: int) -> dict[int, Any]:
    """The fields of a structure by their numbers."""
    found, number = dict[int, Any](), 0
    while head := data.read(1)[0]:
        number = number + (head >> 4) if head >> 4 else _integer(data)
        kind = head & 15
        found[number] = kind == _BOOLEANS[0] if kind in _BOOLEANS else _value(data, kind, depth)
    return found


def _value(data: io.BytesIO, kind: int, depth: int) -> Any:
    if depth == 0:
        raise ValueError("structures too deep within each other")
    if kind in (*_BOOLEANS, _BYTE):
        return data.read(1)[0]
    if kind in _INTEGERS:
        return _integer(data)
    if kind in (_DOUBLE, _TEXT):
        length = 8 if kind == _DOUBLE else _unsigned(data)
        if len(read := data.read(length)) < length:
            raise ValueError("the end is missing")
        return read
    if kind in _LISTS:
        head = data.read(1)[0]
        count = head >> 4 if head >> 4 < 15 else _unsigned(data)
        return [_value(data, head & 15, depth - 1) for _ in range(count)]
    if kind == _MAP:
        kinds = data.read(1)[0] if (count := _unsigned(data)) else 0
        return [(_value(data, kinds >> 4, depth - 1), _value(data, kinds & 15, depth - 1)) for _ in range(count)]
    if kind == _STRUCT:
        return _struct(data, depth - 1)
    raise ValueError(f"a field of kind {kind}")


def _integer(data: io.BytesIO) -> int:
    number = _unsigned(data)
    return (number >> 1) ^ -(number & 1)


def _unsigned(data: io.BytesIO) -> int:
    number = shift = 0
    while (byte := data.read(1)[0]) & 128:
        number, shift = number | (byte & 127) << shift, shift + 7
        if shift > 63:
            raise ValueError("a number of more than 64 bits")
    return number | byte << shift
