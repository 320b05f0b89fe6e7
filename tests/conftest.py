import gc
import logging
import signal
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

import lqrsim as ls

TESTS = Path(__file__).resolve().parent

# Machines may be busy, so examples have no time limit. Where long tests are left out, families are drawn less often
# (tests/helpers/sampling.py) and always the same, and the predictions of runs have fewer trials, unless a test says how
# many. The long run draws others each time, also on servers, and prints how to draw a failing one again.
hypothesis.settings.register_profile("whole", deadline=None, derandomize=False, print_blob=True)
hypothesis.settings.register_profile("short", deadline=None, derandomize=True, database=None, max_examples=20)


def pytest_configure(config: pytest.Config) -> None:
    hypothesis.settings.load_profile("short" if is_short(config) else "whole")
    # Processes that share all tests begin with other files each, so that in a fresh clone each file is compiled by one.
    asked: dict[str, Any] = getattr(config, "workerinput", {})
    if asked and [Path(name).resolve() for name in config.args] == [TESTS]:
        files = sorted(str(path) for path in TESTS.glob("test_*.py"))
        first = len(files) * int(asked["workerid"].removeprefix("gw")) // asked["workercount"]
        config.args[:] = files[first:] + files[:first]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is collected stays until the end: the garbage collector would look through it again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def is_short(config: pytest.Config) -> bool:
    return config.option.markexpr == "not long"


@pytest.fixture(scope="session", autouse=True)
def fewer_trials_of_predictions(pytestconfig: pytest.Config) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        if is_short(pytestconfig):
            patch.setattr("lqrsim.control.tubes.FEWEST_TRIALS", 400)
            patch.setattr("lqrsim.control.tubes.MOST_TRIALS", 400)
        yield


# The slowest files start first: a file is not divided among processors, and one that starts last keeps all waiting.
# In this order the first three files do not compile the same code at the same time.
LONGEST = (
    "kernels", "campaign", "mjcf_robot", "process", "render", "whole_problems", "verify", "json", "cli", "docs",
    "free_duration", "parking", "robustness_api", "hardening", "belief", "failure_commands", "hulls", "funnel", "plots",
    "mjcf_distances", "between_knots", "experiments", "given_solutions", "files", "endings", "closed_loop", "gym",
    "interior_point", "noise", "urdf", "disturbances_all", "league", "cache", "ways", "smoother", "tracking", "levels",
    "arm_pictures", "stated", "gradients", "peers",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    names = [f"test_{name}.py" for name in LONGEST]
    items.sort(key=lambda item: (names.index(item.path.name) if item.path.name in names else len(names), item.path))


@pytest.fixture(scope="session", autouse=True)
def ctrl_c_is_heard() -> Iterator[None]:
    """Restore Ctrl-C: shells start background jobs with SIGINT ignored. Where hang-ups are, as by nohup, they still are
    here, but not by the processes that tests start.
    """
    before = {signal.SIGINT: signal.signal(signal.SIGINT, signal.default_int_handler)}
    hang_up = getattr(signal, "SIGHUP", None)
    if hang_up and signal.getsignal(hang_up) == signal.SIG_IGN:
        before[hang_up] = signal.signal(hang_up, lambda *_: None)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


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
