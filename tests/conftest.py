import logging
import signal
from collections.abc import Iterator

import hypothesis
import pytest

import lqrsim as ls

# Machines may be busy, so examples have no time limit.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


# The slowest files start first: a file is not divided among processors, and one that starts last keeps all waiting.
# In this order the first three files do not compile the same code at the same time.
LONGEST = (
    "kernels", "campaign", "failure_commands", "render", "viewer", "verify", "docs", "disturbances_all", "stated",
    "process", "whole_problems",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    names = [f"test_{name}.py" for name in LONGEST]
    items.sort(key=lambda item: names.index(item.path.name) if item.path.name in names else len(names))


@pytest.fixture(scope="session", autouse=True)
def ctrl_c_is_heard() -> Iterator[None]:
    """Restore Ctrl-C: shells start background jobs with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True)
def log_as_before() -> Iterator[None]:
    """Restore what a test changes of the log: commands print it, and hostile calls silence it."""
    logger = logging.getLogger("lqrsim")
    level, handlers = logger.level, logger.handlers[:]
    yield
    logger.setLevel(level)
    logger.handlers[:] = handlers


@pytest.fixture(scope="session")
def differential_drive() -> ls.Scenario:
    return ls.scenarios.differential_drive()


@pytest.fixture(scope="session")
def quadrotor() -> ls.Scenario:
    return ls.scenarios.quadrotor()


@pytest.fixture(scope="session")
def drive_solution(differential_drive: ls.Scenario) -> ls.Solution:
    return ls.smooth(differential_drive.problem)


@pytest.fixture(scope="session")
def quadrotor_solution(quadrotor: ls.Scenario) -> ls.Solution:
    return ls.smooth(quadrotor.problem)


@pytest.fixture(scope="module")
def arena() -> ls.Plant:
    return ls.Plant(ls.DifferentialDrive(), ls.load_scene("arena"))


@pytest.fixture(scope="module")
def cage() -> ls.Plant:
    return ls.Plant(ls.Quadrotor(), ls.load_scene("cage"))
