"""The dynamics are those of the MJCF, and the policy brings the robot to its goal, undisturbed and disturbed."""

import numpy as np
from my_robot import MyRobot, scenario

import lqrsim as ls


def test_dynamics_are_those_of_the_mjcf() -> None:
    """One control period of both from random states; between knots both integrate by RK4 with other steps."""
    stated = scenario()
    check = ls.check_plant(MyRobot(), stated.scene, problem=stated.problem, period=stated.problem.dt)
    assert check.good, str(check)


def test_the_policy_reaches_its_goal() -> None:
    """Undisturbed on its plan, disturbed in nine of ten runs."""
    stated = scenario()
    plant, solution = stated.plant(), ls.smooth(stated.problem)
    assert solution.status is ls.Status.CONVERGED, str(solution)
    assert plant.clearance(solution.trajectory.states).min() > 0
    undisturbed = ls.simulate(plant, solution)
    assert undisturbed.outcome == ("reached",)
    assert undisturbed.tracking_error.max() < stated.tracking_bound
    disturbed = ls.simulate(plant, solution, disturbances=stated.disturbances, seed=0, trials=20)
    assert np.mean([outcome == "reached" for outcome in disturbed.outcome]) >= 0.9
