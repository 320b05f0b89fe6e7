"""The physics of the closed loop: K simulations of a plant, advanced by one control period at a time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mujoco import batch

from lqrsim.errors import Array, InputError
from lqrsim.results.rollout import WARNINGS
from lqrsim.simulation.plant import Plant
from lqrsim.simulation.simulator import Simulator, states_of

FRAME_PERIOD = 1 / 30  # s; positions are checked and recorded at least this often, unless the physics step is longer


@dataclass(eq=False)
class Period:
    """The result of a control period, in S parts of equal length.

    Attributes:
      states: S arrays (K, n), at the end of each part; angles in any representative.
      frames: S arrays (K, nq), MuJoCo's qpos at these times.
      touching: S arrays (K, obstacles), whether MuJoCo detected a contact at the beginning of the last physics step of
        the part; empty arrays if contacts are not sensed.
      stable: (K,) number of parts, from the first on, in which the simulation was stable.
    """

    states: list[Array]
    frames: list[Array]
    touching: list[npt.NDArray[np.bool_]]
    stable: npt.NDArray[np.int64]


class Physics:
    """K simulations of a plant. Call `place`, then change the models, then `prepare`, then `advance` repeatedly.

    `MujocoPhysics` says what each method does.

    Attributes:
      parts: S, parts of a control period. drawn_parts: number of parts that end with a frame to draw.
      unstable: (K,) whether a simulation has become unstable.
      warnings: (K, 7) number of MuJoCo's warnings of each kind, as in a `Rollout`.
    """

    def __init__(self, plant: Plant, trials: int, substeps: int, part: int) -> None:
        self.plant, self._part, self.parts = plant, part, substeps // part
        self._every = part_of(plant, substeps) // part
        self.drawn_parts = self.parts // self._every
        self.unstable: npt.NDArray[np.bool_] = np.zeros(trials, dtype=bool)
        self.warnings: npt.NDArray[np.int64] = np.zeros((trials, len(WARNINGS)), dtype=np.int64)

    def drawn(self, period: Period) -> list[Array]:
        """The frames that are needed for drawing."""
        return period.frames[self._every - 1 :: self._every]


class SimulatorPhysics(Physics):
    """The physics of a plant with a `Simulator`. Robots pass through obstacles; frames show them in their states."""

    def __init__(self, plant: Plant, simulator: Simulator, trials: int, substeps: int) -> None:
        super().__init__(plant, trials, substeps, part_of(plant, substeps))
        self._simulator, self._factors = simulator, dict[str, Array]()

    def place(self, states: Array) -> None:
        self._states = states

    def multiply(self, parameter: str, factors: Array) -> None:
        if parameter not in self._simulator.parameters:
            raise InputError(f"{parameter}: got a plant simulated by {self._simulator.name}, want one that can")
        self._factors[parameter] = self._factors.get(parameter, 1.0) * factors

    def alter(self, name: str, change: Callable[[batch.Batch], None]) -> None:
        raise InputError(
            f"{name}: got a plant simulated by {self._simulator.name}, want one without a simulator: it changes"
            " MuJoCo's models"
        )

    def displace(self, displaced: Array) -> None:
        """Do nothing: collisions are computed from the positions of the obstacles."""

    def prepare(self, *, altered: bool) -> None:
        self._simulations = self._simulator.start(self._states, self._factors, self.plant.timestep)
        self._look()

    def _look(self) -> None:
        """Read the states. A state with an entry that is not finite becomes NaN."""
        self._states = states_of(self._simulator, self._simulations, self._states.shape)
        lost = ~np.isfinite(self._states).all(axis=1)
        self._states[lost], self.unstable[lost] = np.nan, True

    def state(self) -> Array:
        return self._states.copy()

    def frame(self) -> Array:
        plant = self.plant
        frames = np.tile(plant.model.qpos0, (len(self._states), 1))
        known = np.isfinite(self._states).all(axis=1)
        frames[~known] = np.nan
        frames[np.ix_(known, plant.qpos)] = plant.robot.configuration(self._states[known])[0]
        return frames

    def advance(self, controls: Array, wrench: Array, wind: Array) -> Period:
        period = Period([], [], [], np.full(len(controls), self.parts))
        for part in range(self.parts):
            self._simulator.step(self._simulations, controls, wrench, wind, self._part)
            self._look()
            period.stable[self.unstable] = np.minimum(period.stable[self.unstable], part)
            period.states.append(self.state())
            period.frames.append(self.frame())
            period.touching.append(np.zeros((0, 0), dtype=bool))
        return period

    def kick(self, period: Period, jumps: Array, rows: npt.NDArray[np.intp] | None = None) -> None:
        self._simulator.place(self._simulations, self._states + jumps)
        self._look()
        period.states[-1], period.frames[-1] = self.state(), self.frame()


def part_of(plant: Plant, substeps: int) -> int:
    """Physics steps per frame: the longest equal parts of the control period that are at most FRAME_PERIOD long."""
    longest = min(substeps, int((FRAME_PERIOD + 1e-9) / plant.timestep))
    return max((part for part in range(1, longest + 1) if substeps % part == 0), default=1)
