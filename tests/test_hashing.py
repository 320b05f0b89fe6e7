"""One function hashes all that is kept or compared, and its hashes are those of the bytes."""

import hashlib

import numpy as np

from lqrsim.results.archive import sha256


def test_it_hashes_the_bytes_of_its_parts() -> None:
    matrix = np.arange(6.0).reshape(2, 3)
    assert sha256() == hashlib.sha256(b"").hexdigest()
    assert sha256("né", b"\x00\xff") == hashlib.sha256("né".encode() + b"\x00\xff").hexdigest()
    for array in (
        matrix, matrix.T, matrix[:, ::2], np.asfortranarray(matrix), np.zeros((0, 3)), np.float64(0.1), np.array(7),
        np.array([True, False]), np.array(["a", "longer"]),
    ):  # fmt: skip
        assert sha256("x", array) == hashlib.sha256(b"x" + array.tobytes()).hexdigest()
    assert sha256(matrix) != sha256(matrix.T)
    assert sha256(matrix) == sha256(matrix.ravel())  # the shape is for the caller to say


def test_read_only_arrays_are_hashed_too() -> None:
    array = np.ones(3)
    array.flags.writeable = False
    assert sha256(array) == hashlib.sha256(np.ones(3).tobytes()).hexdigest()
