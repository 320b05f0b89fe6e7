import hypothesis
import pytest

import lqrsim as ls

# How long an example takes is no business of the tests: machines are busy.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


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
