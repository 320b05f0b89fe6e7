"""What bad input is told, in Python and on the command line."""

from collections.abc import Callable

import pytest

from lqrsim.errors import InputError


def refusal(call: Callable[[], object]) -> str:
    """The message with which a call is refused."""
    with pytest.raises(InputError) as caught:
        call()
    return str(caught.value)


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The message of the last command, which must be all that it says of it: one line."""
    lines = capsys.readouterr().err.splitlines(keepends=True)
    (error,) = [line for line in lines if not line.startswith("compiling ")]  # which an empty cache needs
    assert error.startswith("lqrsim: error: ")
    assert error.endswith("\n")
    return error
