"""A goal that a person moves while the robot runs: a ball in the model that a viewer shows, and a final cost."""

import mujoco
import numpy as np

from lqrsim.errors import Array, InputError
from lqrsim.problem.constraints import goals_of
from lqrsim.problem.costs import Cost, CostSum, QuadraticCost, terms_of
from lqrsim.problem.problem import Problem
from lqrsim.scenes.scene import free_name
from lqrsim.simulation.plant import Plant

RGBA = (1.0, 0.72, 0.05, 0.65)  # neither the plan's colour nor the trace's
SHARE = 0.5  # of the robot's radius: a robot that is there can still be seen, and clicked on


class MovableGoal:
    """The place that a problem's final cost asks for.

    Attributes:
      place: where it is in the problem, (2 or 3,).

    Raises:
      InputError: it cannot be moved, for there is none, or more than one.
    """

    def __init__(self, problem: Problem) -> None:
        space = problem.dynamics.state_coordinates
        self._position = list(space.position)
        if not self._position:
            raise InputError("goal: got a robot without a position, want one with a position to move its goal")
        held = [space.names[i] for i in goals_of(problem.constraints, problem.dynamics) if i in self._position]
        if held:
            raise InputError(f"goal: got a GoalState that holds {', '.join(held)}, want a QuadraticCost to move it")
        self._terms = terms_of(problem.final_cost)
        found = [i for i, term in enumerate(self._terms) if self._weighs_place(term)]
        if len(found) != 1:
            raise InputError(
                f"goal: got {len(found)} QuadraticCosts of the position in final_cost, want one to move it"
            )
        (self._number,) = found
        self.place = self._cost.about[self._position]

    @property
    def _cost(self) -> QuadraticCost:
        cost = self._terms[self._number]
        assert isinstance(cost, QuadraticCost)
        return cost

    def _weighs_place(self, term: Cost) -> bool:
        return isinstance(term, QuadraticCost) and bool(term.weight[self._position].any())

    def cost_at(self, place: Array) -> Cost:
        """The final cost with the goal there, (2 or 3,); all else that it asks for stays."""
        about = self._cost.about.copy()
        about[self._position] = place
        terms = list(self._terms)
        terms[self._number] = QuadraticCost(self._cost.weight, about=about)
        return terms[0] if len(terms) == 1 else CostSum(tuple(terms))


def model_with_goal(plant: Plant, goal: MovableGoal) -> tuple[mujoco.MjModel, str]:
    """The plant's model with a body that is the goal, which mice can drag and nothing collides with; and its name."""
    spec = mujoco.MjSpec.from_string(plant.scene.xml)
    space, radius = plant.robot.dynamics.state_coordinates, SHARE * plant.robot.radius
    name = free_name("goal", [body.name for body in spec.bodies])
    body = spec.worldbody.add_body(name=name, mocap=True, pos=space.in_world(goal.place))
    flat = space.from_above
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER if flat else mujoco.mjtGeom.mjGEOM_SPHERE
    size = np.array([radius, 0.1 * radius if flat else 0.0, 0.0])
    body.add_geom(type=kind, size=size, rgba=RGBA, contype=0, conaffinity=0)
    return spec.compile(), name
