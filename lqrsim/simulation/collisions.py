"""The definition of a collision: the first moment at which the robot of a trial touches an obstacle.

The robot touches an obstacle if MuJoCo detects a contact, or if a signed distance minus the radius is negative. The
distance is measured from the robot's position, or from one of its balls or geoms. Detection uses states without
obstacle contacts, so its result is bit-identical whether or not an obstacle then stops the robot. It checks the knots,
the parts of a control period that `Physics` has, and straight lines between them. Obstacles that move, which MuJoCo
does not have, are where they are at each moment.
"""

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array
from lqrsim.problem.collision_shape import ShapeInWorld
from lqrsim.simulation.physics import AnyPhysics, MujocoPhysics, Period

FINEST = 0.02  # smallest step along a line, relative to the radius; a larger clearance is itself the step
MOST_POINTS = 1000  # that are checked along a line


class Collisions:
    """The first collisions of K trials; `passing` is the robot's shape among obstacles that move, at the run's start.

    Attributes:
      at: (K,) times in s; infinite without a collision. obstacles: names of the obstacles; empty without one.
      clearance: (K,) current signed distance to the nearest obstacle, minus the radius, in metres.
    """

    def __init__(self, physics: AnyPhysics, displaced: Array, dt: float, passing: ShapeInWorld | None) -> None:
        self._physics, self.plant, self.shape, self.dt = physics, physics.plant, physics.plant.shape, dt
        self._passing = passing
        moving = () if passing is None else passing.world.obstacles
        self._velocities = np.array([obstacle.velocity for obstacle in moving]).reshape(-1, 3)
        self._fastest = float(np.linalg.norm(self._velocities, axis=1).max(initial=0.0))
        self._displaced, self._any_displaced = self.shape.across(displaced), bool(displaced.any())
        self.at = np.full(len(displaced), np.inf)
        self.obstacles = [""] * len(displaced)
        self._time = 0.0  # of the last places, in s
        self._relocate(physics.state())
        for row in np.flatnonzero(self.clearance < 0):
            self._hit(int(row), 0.0, self._places[row])

    def detect(self, step: int, period: Period, *, ignored: npt.NDArray[np.bool_]) -> None:
        """Find trials, except `ignored` ones (K,), that first collide in a period; obstacles may stop them in it."""
        begun, parts = self.at.copy(), len(period.states)
        for part, (states, touching) in enumerate(zip(period.states, period.touching, strict=True)):
            running = np.isinf(self.at) & ~ignored & (part < period.stable)
            self._touch((step + part / parts) * self.dt, touching, running)
            if len(self.plant.world) or len(self._velocities):
                self._search_line(step, part, parts, self.shape.places(states), running)
        rows = np.flatnonzero(np.isfinite(self.at) & np.isinf(begun))
        # Rounding may put a time in the period past the period's end.
        self.at[rows] = np.minimum(self.at[rows], (step + 1) * self.dt)
        if len(rows) and isinstance(self._physics, MujocoPhysics) and self._physics.solidifies:
            self._physics.rerun_with_contacts(rows, period)
            self._relocate(period.states[-1])

    def detect_at_end(self, time: float, *, ignored: npt.NDArray[np.bool_]) -> None:
        """Detect contacts at the last knot, which no period follows."""
        if isinstance(self._physics, MujocoPhysics) and self._physics.senses_contacts:
            self._touch(time, self._physics.touching_now(), np.isinf(self.at) & ~ignored)

    def _touch(self, time: float, touching: npt.NDArray[np.bool_], running: npt.NDArray[np.bool_]) -> None:
        """Record contacts that MuJoCo detected, (K, obstacles), in the `running` trials (K,)."""
        for row in np.flatnonzero(running & touching.any(axis=1)):
            self.at[row] = time
            self.obstacles[row] = self.plant.obstacles[int(np.argmax(touching[row]))]

    def _relocate(self, states: Array) -> None:
        """Replace the current states, as after obstacles have stopped some of the trials."""
        self._places = self.shape.places(states)
        self.clearance = self._clear(self._places, self._time)

    def _search_line(self, step: int, part: int, parts: int, arrived: Array, running: npt.NDArray[np.bool_]) -> None:
        """Check the lines from the robot's last positions to the new ones, (K, B, 2 or 3) or (K, 1, n)."""
        last, before = self._places, self.clearance
        self._time = (step + (part + 1) / parts) * self.dt
        self._places, self.clearance = arrived, self._clear(arrived, self._time)
        length = self.shape.travel(last, arrived) + self._fastest * self.dt / parts  # moves of robot and obstacles
        # If the clearances at both ends add up to more than the length, no point of the line touches an obstacle.
        rows = np.flatnonzero(running & np.isinf(self.at) & ~(before + self.clearance > length))
        rows = rows[np.isfinite(length[rows])]
        if not len(rows):
            return
        finest = np.maximum(FINEST * float(self.shape.radii.min()), length[rows] / MOST_POINTS)
        travelled, clear = np.zeros(len(rows)), before[rows]
        searching = np.ones(len(rows), dtype=bool)
        while searching.any():
            travelled = np.where(searching, np.minimum(travelled + np.maximum(clear, finest), length[rows]), travelled)
            ratio = (travelled / np.where(length[rows] > 0, length[rows], 1.0))[:, None, None]
            at_end = travelled >= length[rows]
            places = np.where(at_end[:, None, None], arrived[rows], last[rows] + ratio * (arrived[rows] - last[rows]))
            times = (step + (part + ratio[:, 0, 0]) / parts) * self.dt
            clear = self._clear(places, times, rows)
            for k in np.flatnonzero(searching & (clear < 0)):
                self._hit(int(rows[k]), float(times[k]), places[k])
            searching &= (clear >= 0) & ~at_end

    def _clear(self, places: Array, time: float | Array, rows: npt.NDArray[np.intp] | slice = slice(None)) -> Array:
        """The clearance (k,) of these trials with their balls at places (k, B, 2 or 3), at times (k,) in s."""
        clear = self.shape.clearance(places, self._displaced[rows] if self._any_displaced else None)
        if self._passing is None:
            return clear
        return np.minimum(clear, self._passing.clearance(places, self._motion(np.broadcast_to(time, len(places)))))

    def _motion(self, times: Array) -> Array:
        """How far the moving obstacles have come at times (k,) in s, (k, obstacles, 3) in m."""
        return times[:, None, None] * self._velocities

    def _hit(self, row: int, time: float, places: Array) -> None:
        """Record a collision with the obstacle that is nearest to the balls at these places (B, 2 or 3)."""
        self.at[row] = time
        moved = self._motion(np.array([time]))
        if self._passing is None or not self._passing.clearance(places[None], moved)[0] < 0:
            self.obstacles[row] = self.plant.world.names[self.shape.nearest(places, self._displaced[row])]
        else:
            self.obstacles[row] = self._passing.world.names[self._passing.nearest(places, moved[0])]
