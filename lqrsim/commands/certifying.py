"""The command that says from where a policy works."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from lqrsim.commands.options import Folder, Json, Policy, SolutionFile, optional


@dataclass(frozen=True, kw_only=True)
class Funnel:
    """Find from how far off its plan a policy still works.

    Prints, for some knots of the plan, the largest ellipsoid about it from which runs under disturbances reach the goal
    at the wished rate, and the fresh trials that certify it. Writes funnel.npz, and funnel.png where the robot has a
    position. Solves the scenario first, unless a solution is given.

      lqrsim funnel quadrotor --disturbances light --rate 0.9
      lqrsim funnel differential_drive --states x y --knots 0 50 100

    Exits with 1 if there is no level at any knot.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """As in `lqrsim solve`."""
    disturbances: Annotated[tuple[str, ...], optional("NAME ...")] = ("scenario",)
    """Sets by name, as in `lqrsim simulate`. By default those of the scenario's demo."""
    strength: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """Factor by which the disturbances are scaled."""
    policy: Policy = "smooth"
    """As in `lqrsim stress`."""
    stated: Annotated[str | None, optional("NAME")] = None
    """Disturbances for which track or offset_free is designed, as in `lqrsim stress`. By default moderate."""
    solution: SolutionFile = None
    rate: float = 0.99
    """Wished share of runs that reach the goal."""
    confidence: float = 0.95
    """That all levels are right."""
    knots: Annotated[tuple[int, ...], optional("N ...")] = ()
    """Numbers of the knots at which runs begin. By default five, from the first on."""
    states: Annotated[tuple[str, ...], optional("NAME ...")] = ()
    """States that may be off the plan. By default all."""
    failures: int = 3
    """Failures allowed in a test. With more, there are more trials, and levels come out larger."""
    goal_radius: Annotated[float | None, optional("METRES")] = None
    """Distance from the goal within which it counts as reached. By default the robot's radius."""
    goal_tolerance: Annotated[float | None, optional("SHARE")] = None
    """The same for goals without a position, relative to each state's range along the plan. By default 0.1."""
    seed: int = 0
    """Seed of all random numbers. The same seed gives the same output."""
    out: Folder = None
    """Output folder. By default runs/funnel/ and the name of the scenario."""
    json: Json = False
    """Print the result as one JSON object, and everything else to stderr; see docs/json.md."""

    def run(self) -> int:
        """Run the command. Returns the exit code."""
        from lqrsim.commands import as_json, console
        from lqrsim.results import save_load
        from lqrsim.scenarios.references import folder_name, resolve
        from lqrsim.scenarios.solutions import given
        from lqrsim.stress.funnels import funnel
        from lqrsim.stress.sweeps import sweep
        from lqrsim.stress.trials import controller_of, solve
        from lqrsim.view.funnel_plot import plot_funnel

        scenario = resolve(self.scenario)
        folder = self.out or Path("runs/funnel") / folder_name(scenario)
        console.check_output("--out", folder)
        wrong = [one.scaled(self.strength) for name in self.disturbances for one in sweep(name, scenario)]
        stated = None if self.stated is None else sweep(self.stated, scenario)
        solution = None if self.solution is None else given(scenario, self.solution)
        solution = solve((self.policy,), scenario, stated, solution)[self.policy]
        with console.long_progress("looking", "knot") as progress:
            found = funnel(
                scenario.plant(),
                solution,
                disturbances=wrong,
                controller=controller_of(self.policy, scenario, solution, stated=stated),
                rate=self.rate,
                confidence=self.confidence,
                knots=self.knots or None,
                states=self.states or None,
                failures=self.failures,
                seed=self.seed,
                progress=progress,
                **scenario.near_enough(self.goal_radius, self.goal_tolerance),
            )
        console.say(found.summary())
        console.result(funnel=as_json.of_funnel(found))
        console.wrote(save_load.save(found, folder / "funnel.npz"))
        place = scenario.problem.dynamics.state_coordinates.position
        if place and set(place) <= set(found.chosen):
            world, radius = scenario.scene.world, scenario.robot.radius
            console.wrote(plot_funnel(found, folder / "funnel.png", world=world, radius=radius))
        return 0 if found.levels.any() else 1
