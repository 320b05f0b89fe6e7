"""From disturbances, as `simulate` takes them, to what filters, tracking laws and tubes are made of."""

from collections.abc import Sequence

from lqrsim.control.uncertainty import Uncertainty, gathered
from lqrsim.errors import check_kind
from lqrsim.problem.noise import Noise
from lqrsim.simulation.disturbances import Disturbance
from lqrsim.simulation.disturbances.state_noise import as_disturbances
from lqrsim.simulation.plant import Plant


def uncertainty_of(plant: Plant, disturbances: Sequence[Disturbance | Noise]) -> Uncertainty:
    """What disturbances are to a plan, in numbers: zero-mean and Gaussian, or left out by name.

    What is stated as fixed (`MeanWind`, a mismatch's `factor`) counts as unknown, with its size as the standard
    deviation. What is drawn from a normal distribution that is cut counts with the standard deviation of what is left.
    Losses in bursts count as if each were on its own, and obstacles as displaced by the same along all axes. What
    nothing stands for is in `left_out`, with the reason: what the robot's dynamics do not declare, and what is not
    small, not lasting or not linear, as a push, narrower limits or the loss of an actuator.

    Args:
      plant: what is run.
      disturbances: as in `simulate`; those of one's own have a method `uncertainty`.

    Returns:
      The Uncertainty.

    Raises:
      InputError: a disturbance does not fit the plant.
    """
    check_kind("plant", plant, Plant, "a Plant, such as scenario.plant()")
    parts = list[Uncertainty]()
    for one in as_disturbances(disturbances, "a list of disturbances"):
        one.check(plant)
        field = f"{type(one).__name__}: uncertainty"
        parts.append(check_kind(field, one.uncertainty(plant), Uncertainty, "a method that returns an Uncertainty"))
    total = gathered(parts)
    total.check(plant.robot.dynamics)
    return total
