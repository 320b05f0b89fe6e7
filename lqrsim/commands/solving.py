"""Commands from a new robot to its runs, in MuJoCo or on a robot that speaks ROS 2. The demo, and compiled solvers."""

import builtins
import importlib.util
import itertools
import keyword
import math
import shlex
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

import lqrsim as ls
from lqrsim.commands import console
from lqrsim.commands.options import ControllerName, DesignSet, Folder, Json, arguments_for, optional, options_of, refuse

if TYPE_CHECKING:
    from lqrsim.control.controllers import ControllerLike
    from lqrsim.solvers.settings import StartLike


@dataclass(frozen=True, kw_only=True)
class List:
    """Print scenarios: robot, scene, states and controls with units.

    Of an MJCF or a URDF it also prints what holds the robot at rest, its limits, contacts and obstacles.
    """

    scenarios: Annotated[Positional[tuple[str, ...]], arg(metavar="SCENARIO ...", help_behavior_hint="")] = ()
    """As for `lqrsim solve`, such as the path of a robot; by default the packaged ones."""

    json: Json = False

    def run(self) -> int:
        from lqrsim.scenarios.references import resolve

        scenarios = {name: resolve(name) for name in self.scenarios or ls.scenarios.names()}
        for name, scenario in scenarios.items():
            problem = scenario.problem
            console.say(f"{name}: {scenario.summary}")
            console.say(f"  robot:    {scenario.robot.name} in scene {scenario.scene.name}")
            console.say(f"  horizon:  {problem.steps} steps of {problem.dt:.4g} s")
            console.say(f"  states:   {', '.join(problem.dynamics.state_coordinates.labels)}")
            console.say(f"  controls: {', '.join(problem.dynamics.control_coordinates.labels)}")
            for line in str(scenario.robot).splitlines()[2:]:  # of a robot from an MJCF; the first two say the same
                console.say(line)
        console.result(scenarios=[console.of_scenario(name, scenario) for name, scenario in scenarios.items()])
        return 0


TEMPLATE, CLASS = "my_robot", "MyRobot"
TEMPLATES = Path(__file__).parent.parent / "templates" / TEMPLATE
# Names with another meaning: those used in the written files, MuJoCo's first body, pytest's own file, Windows' devices.
RESERVED = {
    "any", "path", "self", "world", "conftest", "con", "prn", "aux", "nul",
    *(f"{port}{number}" for port in ("com", "lpt") for number in range(10)),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class New:
    """Write the files of a new robot.

    The folder contains an MJCF, dynamics, a scenario and a test. They work unchanged: a disc is pushed round a crate.
    Prints the commands that solve, simulate, render and test it. docs/new_robot.md explains the changes to make.
    """

    name: Annotated[Positional[str], arg(metavar="NAME")]
    """Name of the robot, a name that Python can import: lower-case letters, digits and underscores."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path(".")
    """Folder in which the robot's folder is made."""

    def run(self) -> int:
        from lqrsim.results.archive import excerpt_of, write_text

        check_robot_name(self.name)
        folder = self.out / self.name
        console.check_output("--out", self.out)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise ls.InputError(f"name: got {self.name!r}, want one without a folder {excerpt_of(folder)}") from None
        except OSError as error:
            got = excerpt_of(self.out)
            raise ls.InputError(f"--out: got {got}, want a folder that can be written ({error})") from None
        try:
            for template in sorted(TEMPLATES.glob("*.*")):
                path = folder / _named(template.name, self.name)
                write_text(path, _named(template.read_text(encoding="utf-8"), self.name))
                console.wrote(path)
        except BaseException:  # as on a full disk: the same command can then be given again
            shutil.rmtree(folder, ignore_errors=True)
            raise
        scenario, runs = f"{(folder / self.name).as_posix()}.py:scenario", f"runs/{self.name}"
        console.say("\nnext:")
        for command in (
            ["lqrsim", "solve", scenario],
            ["lqrsim", "simulate", f"{runs}/solution.npz", "--scenario", scenario, "--disturbances", "scenario"],
            ["lqrsim", "render", f"{runs}/rollout.npz"],
            ["python", "-m", "pytest", folder.as_posix()],
        ):
            console.say(f"  {shlex.join(command)}")
        return 0


def check_robot_name(name: str) -> None:
    """Raise InputError unless a new module can have this name."""
    from lqrsim.errors import excerpt

    wanted = "lower-case letters, digits and underscores, beginning with a letter, such as my_robot"
    plain = name.isascii() and name.isidentifier() and name == name.lower() and name[0] != "_" and len(name) <= 60
    if not plain or keyword.iskeyword(name):
        raise ls.InputError(f"name: got {excerpt(name)}, want {wanted}")
    reserved = RESERVED | {word.lower() for word in (*dir(builtins), *keyword.kwlist)}
    if name in reserved:
        raise ls.InputError(f"name: got {name!r}, which has another meaning in Python, MuJoCo or Windows, want another")
    spec = importlib.util.find_spec(name)
    if spec is not None and spec.origin is not None:  # a folder without modules has no origin
        raise ls.InputError(f"name: got {name!r}, which is a module of Python or of a package, want another name")


def _named(text: str, name: str) -> str:
    return text.replace(TEMPLATE, name).replace(CLASS, "".join(part.capitalize() for part in name.split("_")))


@dataclass(frozen=True, kw_only=True)
@options_of(
    "solvers/smoother.py", "smooth", tolerance="SHARE", max_iterations="INT", time_limit="SECONDS", starts="INT"
)
class Solve:
    """Compute a feedback policy for a scenario.

    Prints each iteration as it ends, from the hundredth on every tenth, then the status and, if it failed, the remedy.
    Writes solution.npz in any case; the exit code is 1 if the solver did not converge. Ctrl-C writes the best plan so
    far to stopped.npz, from which --start goes on.
    """

    scenario: Annotated[Positional[str], arg(metavar="SCENARIO")]
    """A name from `lqrsim list`; your own function that returns a Scenario, file.py:name or module:name; or an MJCF
    or URDF file, file.xml. Settings follow after commas: quadrotor,query=3 or
    "cartpole.xml,start={'pole': 3.14},steps=200"."""
    out: Folder = None
    """Folder for solution.npz. By default runs/ and the name of the scenario."""
    solver: Literal["smooth", "ilqr"] = "smooth"
    """smooth: iterated LQR smoothing. ilqr: the baseline with line search, from the scenario's exact start."""
    stop: Literal["optimal", "cost"] = "optimal"
    """cost: stop when the cost has settled, as in the paper. optimal: also require gap and first-order optimality."""
    finish: Literal["newton", "none"] = "newton"
    """newton: smooth leaves the last iterations to Newton's method. none: the paper's method does them all."""
    starts: int | None = None
    start: Annotated[Path | None, optional("FILE.npz")] = None
    """Begin with a stored solution or policy, or with the plan of a rollout or a funnel, of the same robot and with the
    same number of steps. By default the scenario's own start, or a search."""
    paper_start: bool = False
    """Begin as in the paper: from the nominal control, with the scenario's prior."""
    clearance: Annotated[float | None, optional("METRES")] = None
    """Constrain the distance to all obstacles to at least this, at the steps. By default obstacles only add cost."""
    control_limits: Annotated[tuple[float, float] | None, optional("LOWEST HIGHEST")] = None
    """Limits of every control for planning, in its unit. By default the actuators' limits."""
    figure: Annotated[Path | None, optional("FILE")] = None
    """Also plot the policy to FILE.png, .pdf or .svg: the predicted tube under the scenario's disturbances, the
    cost-to-go along the plan, and the gains over time."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.scenarios.references import folder_name, from_anywhere, resolve

        scenario = resolve(self.scenario)
        folder = self.out or Path("runs") / folder_name(scenario)
        console.check_output("--out", folder)
        if self.figure is not None:
            from lqrsim.view.style import METADATA

            console.check_output("--figure", self.figure, "file", suffixes=METADATA)
        problem = scenario.problem
        if self.clearance is not None:
            clearance = ls.Clearance(scenario.scene.world, **scenario.robot.shape, margin=self.clearance)
            problem = replace(problem, constraints=[*problem.constraints, clearance])
        if self.control_limits is not None:
            problem = replace(problem, control_limits=self.control_limits)
        if self.solver != "smooth":
            refuse(self, ("finish", "starts", "paper_start"), f"with --solver {self.solver}, want it with smooth")
        settings = {name: getattr(self, name) for name in ("tolerance", "max_iterations", "time_limit", "starts")}
        options = {"stop": self.stop, **{name: value for name, value in settings.items() if value is not None}}
        if self.finish == "none":
            options["finish"] = None
        scenario = replace(scenario, problem=problem, start=self._start(scenario))
        reference = from_anywhere(self.scenario)
        try:
            solved = console.solve_and_print(scenario, self.solver, **options)
        except KeyboardInterrupt as stop:
            if (best := getattr(stop, "solution", None)) is not None:  # a file of its own: solution.npz may be better
                console.say(console.summary_of(best))
                console.save(replace(best, scenario=reference), folder / "stopped.npz")
            raise
        solution = replace(solved, scenario=reference)
        console.save(solution, folder / "solution.npz")
        console.result(solution=console.of_solution(solution))
        if self.figure is not None:
            _plot_policy(scenario.with_duration_of(solution), solution, self.figure)
        return 0 if solution.success else 1

    def _start(self, scenario: "ls.Scenario") -> "StartLike":
        """The start of the solve. Raises InputError for several starts, or a start that the scenario lacks."""
        from lqrsim.scenarios.solutions import stored_start

        choices = {"--start": self.start is not None, "--paper-start": self.paper_start, "--starts": self.starts}
        named = [name for name, chosen in choices.items() if chosen]
        if len(named) > 1:
            raise ls.InputError(f"{', '.join(named)}: got {len(named)} of them, want one: each chooses the start")
        if self.start is not None:
            return stored_start(scenario, self.start)
        if self.paper_start:
            if scenario.paper_start is None:
                raise ls.InputError(f"--paper-start: got {scenario.name}, want a scenario of the paper")
            return scenario.paper_start
        return None if self.starts is not None else scenario.start


def tube_under(
    problem: "ls.Problem", solution: "ls.Solution", plant: "ls.Plant",
    disturbances: "Sequence[ls.disturbances.Disturbance]", controller: "ControllerLike | None" = None,
) -> "tuple[ls.types.Tube | None, str]":  # fmt: skip
    """The predicted tube of a run, if there is one, and a line on what it leaves out, or why there is none.

    Without disturbances there is neither a tube nor a line.
    """
    import numpy as np

    from lqrsim.problem.belief import Belief

    if not disturbances:
        return None, ""
    try:
        uncertainty = None if isinstance(problem.dynamics, Belief) else ls.uncertainty_of(plant, disturbances)
        if not problem.dynamics.state_coordinates.position:
            raise ls.InputError("the robot has no position")
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable loop overflows; it is refused below
            tube = ls.predict_tube(problem, solution, uncertainty, controller)
        if not np.isfinite(tube.covariance).all():
            raise ls.InputError("the loop is not stable, its covariance is not finite")
    except ls.InputError as error:
        return None, f"no predicted tube: {error}"
    if uncertainty is None:
        return tube, "the predicted tube has the noise and the readings of the plan, and no other disturbances"
    left_out = uncertainty.left_out
    return tube, f"the predicted tube leaves out {'; '.join(left_out)}" if left_out else ""


def _plot_policy(scenario: "ls.Scenario", solution: "ls.Solution", path: Path) -> "ls.types.Tube | None":
    """Plot the policy of a solution of a scenario, which has its duration. Returns the tube, if one is predicted."""
    from lqrsim.problem.belief import Belief

    tube, remark = tube_under(scenario.problem, solution, scenario.plant(), scenario.disturbances)
    if remark:
        console.say(remark)
    if solution.cost_to_go is None:
        console.say("no figure: the solve has no cost-to-go, which it shows")
        return tube
    dynamics = scenario.problem.dynamics
    options = {"tube": tube, "belief": dynamics if isinstance(dynamics, Belief) else None}
    world, radius = scenario.scene.world, scenario.robot.shape.get("radius", 0.0)
    console.wrote(ls.view.plot_policy(solution, path, world=world, radius=radius, **options))
    return tube


@dataclass(frozen=True, kw_only=True)
@options_of("simulation/closed_loop.py", "simulate", seed="INT", trials="INT", first_trial="INT")
@options_of("stress/study.py", "Setup", goal_radius="METRES", goal_tolerance="SHARE")
@options_of("stress/study.py", "Study", strength="FACTOR")
class Simulate:
    """Run a policy in MuJoCo, in closed loop.

    Writes the runs to rollout.npz, with the tube predicted for their disturbances. Prints where the plan ends, one line
    per trial, and how many reached the goal. By default there are no disturbances. The same seed gives bit-identical
    results on equal processors.

      lqrsim simulate SOLUTION.npz --force-noise 0.1 --push 0.2 0 0 3.0 --trials 10
      lqrsim simulate SOLUTION.npz --disturbances severe --out runs/severe
      lqrsim simulate SOLUTION.npz --disturbances severe --open-loop --out runs/open_loop   # same random numbers
    """

    solution: Annotated[Positional[Path], arg(metavar="SOLUTION")]
    """A file from `lqrsim solve`."""
    scenario: Annotated[str | None, optional("SCENARIO")] = None
    """Robot and scene, as in `lqrsim solve`. By default the scenario that was solved, if `lqrsim list` has it. Files
    never choose code to run: name your own function here."""
    out: Folder = None
    """Folder for rollout.npz. By default the folder of the solution."""
    open_loop: bool = False
    """Run the plan without feedback: its controls, whatever the state."""
    controller: ControllerName = "feedback"
    """feedback: the solution's policy. track: follows its plan. offset_free: also estimates the state and the
    disturbances. replan: solves again every tenth of the horizon."""
    design_disturbances: DesignSet = None
    disturbances: Annotated[tuple[str, ...], optional("NAME ...")] = ()
    """Sets by name, as in `lqrsim stress --sweep`: a preset (calm, light, moderate, strong, severe), or scenario for
    the set of the scenario's demo; NAME:KIND for one kind alone. The options below add to them."""
    strength: float = 1.0
    control_noise: Annotated[float, arg(metavar="STD")] = 0.0
    """Standard deviation of white noise on each control, in the control's unit (m/s wheel speed, N rotor force)."""
    force_noise: Annotated[float, arg(metavar="STD")] = 0.0
    """Standard deviation of a random force at the centre of mass, drawn anew each control period, in N along each
    axis."""
    measurement_noise: Annotated[tuple[float, ...], optional("STD ...")] = ()
    """Standard deviation of white noise on each measured state, in its unit: one number per state, or one for all."""
    push: Annotated[tuple[float, float, float, float] | None, optional("X Y Z AT")] = None
    """One push: its impulse in N s along the world's axes, and its time in s."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.scenarios.references import disturbance_set
        from lqrsim.stress.study import DEFAULT_DESIGN, DESIGNED, check_designed, make_controller

        if self.open_loop and self.controller != "feedback":
            raise ls.InputError(f"--open-loop: got --controller {self.controller} as well, want one of the two")
        if not self.disturbances:
            refuse(self, ("strength",), "without --disturbances, whose sets it scales, want it with these")
        folder = self.out or self.solution.parent
        console.check_output("--out", folder)
        solution, scenario = console.load_with_scenario(self.solution, self.scenario)
        if self.open_loop:
            solution = solution.open_loop()
        check_designed(self.design_disturbances, (self.controller,))
        controller = make_controller(self.controller, scenario, solution, design=self.design_disturbances)
        named = [disturbance for name in self.disturbances for disturbance in disturbance_set(name, scenario)]
        disturbances = [*(disturbance.scaled(self.strength) for disturbance in named), *self._single_disturbances()]
        plant, goal = scenario.plant(), scenario.near_enough(**arguments_for(scenario.near_enough, self))
        options = arguments_for(ls.simulate, self, controller=controller, disturbances=disturbances, **goal)
        with console.Progress("simulating", "step") as progress:
            rollout = ls.simulate(plant, solution, progress=progress, **options)
        console.say(rollout.summary())
        if self.controller in DESIGNED and self.design_disturbances is None:
            console.say(f"{self.controller} was designed for {DEFAULT_DESIGN}; for others: --design-disturbances NAME")
        violations = _violations(scenario.problem, rollout)
        for violation in (violation for violation in violations or () if violation["trials"]):
            where = f"trial {violation['trial']} at {violation['time']:.2f} s"
            by = f"{violation['constraint']}, by up to {violation['most']:.3g} ({where}); outcomes do not count this"
            console.say(f"{violation['trials']} of {rollout.trials} trials violate a constraint, {by}")
        for site, errors in scenario.problem.site_errors(rollout.states[:, -1]).items():
            worst = max(((error, k) for k, error in enumerate(errors.tolist()) if error == error), default=None)
            if worst is not None:
                unit = "rad" if " turned" in site else "m"
                off = f"{worst[0]:.3g} {unit} off (trial {rollout.first_trial + worst[1]})"
                console.say(f"{site} ends up to {off}; outcomes do not count this")
        if violations is None and scenario.problem.constraints:
            console.say("trials are not checked for violations: another horizon, or constraints of a belief")
        tube, remark = tube_under(scenario.problem, solution, plant, disturbances, controller)
        if remark:
            console.say(remark)
        rollout = rollout if tube is None else tube.added_to(rollout)
        console.save(rollout, folder / "rollout.npz")
        console.say(rollout.tally())
        if console.wants_result():
            run = console.of_rollout(rollout, scenario.problem)
            console.result(run=run, violations=violations, tube_leaves_out=remark)
        return 0

    def _single_disturbances(self) -> "list[ls.disturbances.Disturbance]":
        disturbances: list[ls.disturbances.Disturbance] = []
        if self.control_noise:
            disturbances.append(ls.disturbances.ControlNoise(self.control_noise))
        if self.force_noise:
            disturbances.append(ls.disturbances.ForceNoise(self.force_noise))
        if self.measurement_noise:
            std = self.measurement_noise
            disturbances.append(ls.disturbances.MeasurementNoise(std[0] if len(std) == 1 else std))
        if self.push:
            *impulse, at = self.push
            disturbances.append(ls.disturbances.Push(impulse, at=at))
        return disturbances


@dataclass(frozen=True, kw_only=True)
@options_of("bridge.py", "run", seconds="SECONDS", lost_after="SECONDS", patience="SECONDS", domain="NUMBER")
class Bridge:
    """Run a policy on a robot, by messages of ROS 2; needs lqrsim[ros].

    Reads states from an Odometry or a JointState and publishes a Float64MultiArray in each control period. The safe
    command is published last: at the end, if states stay away, on an error and on Ctrl-C. docs/bridge.md describes
    units, frames and reactions to events. Exits with 1 if it had to stop early.

      lqrsim bridge runs/quadrotor/solution.npz --odometry /odom --commands /rotors/commands --safe 0 0 0 0
      lqrsim bridge runs/quadrotor/solution.npz --odometry /odom --commands /rotors/commands --robot  # in place of it
    """

    policy: Annotated[Positional[Path], arg(metavar="POLICY.npz")]
    """A file from `lqrsim solve`, or a policy from `ls.save`: of ls.track, or of ls.OffsetFree with its filter."""
    commands: Annotated[str, arg(metavar="TOPIC")]
    """Topic of the commands, a std_msgs/msg/Float64MultiArray."""
    odometry: Annotated[str | None, optional("TOPIC", "Topic of the states, a nav_msgs/msg/Odometry.")] = None
    joints: Annotated[str | None, optional("TOPIC", "Topic of the states, a sensor_msgs/msg/JointState.")] = None
    names: Annotated[tuple[str, ...], optional("STATE=NAME ...")] = ()
    """Names of states in the messages, where they differ: theta=heading."""
    safe: Annotated[tuple[float, ...], optional("CONTROL ...")] = ()
    """The command for a robot that nobody controls any more: one number for each control. There is no default."""
    lockstep: FlagCreatePairsOff[bool] = False
    """Run a control period for each state that arrives, and not by the clock: for simulations."""
    robot: FlagCreatePairsOff[bool] = False
    """Be the robot: MuJoCo runs the solution's scenario with the commands that arrive."""
    scenario: Annotated[str | None, optional("SCENARIO", "With --robot, as in `lqrsim simulate`.")] = None
    json: Json = False

    def run(self) -> int:
        from lqrsim import bridge

        pairs = [pair.partition("=") for pair in self.names]
        if any(not (state and equals and name) for state, equals, name in pairs):
            raise ls.InputError(f"--names: got {' '.join(self.names)}, want pairs such as theta=heading")
        names = {state: name for state, _, name in pairs}
        if len(names) < len(pairs):
            raise ls.InputError(f"--names: got {' '.join(self.names)}, want each state at most once")
        if self.robot:
            refuse(self, ("safe", "lockstep", "seconds", "lost_after"), "with --robot, want it without")
            return self._be_robot(names)
        refuse(self, ("scenario",), "without --robot, want it with that")
        if not self.safe:
            raise ls.InputError("--safe: got none, want the command for a robot that nobody controls, such as 0 0 0 0")
        policy: Any = ls.load(self.policy)
        ran = bridge.run(policy, **arguments_for(bridge.run, self, names=names))
        console.say(ran.summary())
        numbers = {"held": ran.held, "refused": ran.refused[0], "response": ran.response, "late": ran.late}
        console.result(periods=len(ran.commands), completed=ran.completed, reason=ran.reason, **numbers)
        return 0 if ran.completed else 1

    def _be_robot(self, names: dict[str, str]) -> int:
        from lqrsim import bridge

        solution, scenario = console.load_with_scenario(self.policy, self.scenario)
        with bridge.SimulatedRobot(solution, **arguments_for(bridge.SimulatedRobot, self, names=names)) as robot:
            rollout = ls.simulate(scenario.plant(), solution, controller=robot, **scenario.near_enough())
        console.say(rollout.summary())
        console.say(robot.summary())
        console.result(outcome=rollout.outcome, round_trips=robot.round_trips)
        return 0 if rollout.outcome == ("reached",) else 1


def _violations(problem: "ls.Problem", rollout: "ls.Rollout") -> list[dict[str, Any]] | None:
    """How many trials violate each constraint, and the worst; None for another horizon, or constraints of a belief."""
    from lqrsim.problem.belief import Belief

    other = (problem.steps, problem.dt) != (rollout.plan.steps, rollout.plan.dt)
    if other or isinstance(problem.dynamics, Belief):
        return None
    listed = list[dict[str, Any]]()
    for name, excesses in problem.violations(rollout).items():
        worst, count = int(excesses[:, 0].argmax()), int((excesses[:, 0] > 0).sum())
        excess, time = excesses[worst].tolist()
        where = {"trial": rollout.first_trial + worst, "time": time} if count else {"trial": None, "time": None}
        listed.append({"constraint": name, "trials": count, "most": excess, **where})
    return listed


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Solve, simulate and render both robots.

    Each is solved with smooth(), and its policy is run undisturbed and then disturbed. Writes the solution, both
    rollouts, figures of the policy and of the runs, and a video.

    Exits with 1 if a plan did not converge or an undisturbed run leaves its plan by more than the scenario's bound.
    """

    robots: Annotated[tuple[str, ...], arg(metavar="SCENARIO ...")] = ("differential_drive", "quadrotor")
    """Scenarios, by their names in `lqrsim list`; settings follow after commas: quadrotor,query=3."""
    out: Annotated[Path, arg(metavar="FOLDER")] = Path("videos")
    """Output folder, with a folder for each scenario."""
    seed: int = 0
    """Seed of the disturbances."""
    video: bool = True
    """--no-video skips the videos."""
    quick: bool = False
    """Smaller videos with fewer frames, for a first look."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.control.controllers import BeliefFeedback
        from lqrsim.scenarios.references import folder_name, from_anywhere, resolve
        from lqrsim.stress.study import make_controller
        from lqrsim.view import cameras, gl

        console.check_output("--out", self.out)
        scenarios, video = {reference: resolve(reference) for reference in self.robots}, self.video
        if video and (reason := gl.missing()):
            console.say(f"No videos, everything else works: {reason}")
            video = False
        folders = dict[Path, str]()
        for reference, scenario in scenarios.items():
            if (other := folders.setdefault(self.out / folder_name(scenario), reference)) != reference:
                wanted = f"want one of them: {self.out / folder_name(scenario)} is the folder of both"
                raise ls.InputError(f"--robots: got {other} and {reference}, {wanted}")
        rows, failures, misses = [TABLE], list[str](), list[str]()
        results = list[console.Object]()
        for reference, scenario in scenarios.items():
            folder = self.out / folder_name(scenario)
            console.say(f"\n== {reference}: {scenario.summary}")
            solution = replace(console.solve_and_print(scenario), scenario=from_anywhere(reference))
            console.save(solution, folder / "solution.npz")
            scenario = scenario.with_duration_of(solution)
            tube = _plot_policy(scenario, solution, folder / "policy.png")
            law = make_controller("feedback", scenario, solution)
            plan, belief = (law.plan, law.belief) if isinstance(law, BeliefFeedback) else (solution, None)
            if not solution.success:
                failures.append(f"{reference}: the plan did not converge ({solution.status.name})")
            runs = dict[str, ls.Rollout]()
            for name, disturbances in {"undisturbed": (), "disturbed": scenario.disturbances}.items():
                options = {"disturbances": disturbances, "seed": self.seed, **scenario.near_enough()}
                with console.Progress("simulating", "step") as progress:
                    rollout = ls.simulate(scenario.plant(), plan, controller=law, progress=progress, **options)
                console.say(rollout.summary())
                runs[name] = tube.added_to(rollout) if tube is not None and name == "disturbed" else rollout
                console.save(runs[name], folder / f"{name}.npz")
                rows.append(_row(reference, name, solution, rollout))
            undisturbed = runs["undisturbed"]
            worst, unit = float(undisturbed.tracking_error.max()), undisturbed.tracking_unit
            if not worst <= scenario.tracking_bound:  # also true for the NaN of a diverged run
                bound = f"want <= {scenario.tracking_bound:g} {unit}"
                failures.append(f"{reference}: undisturbed up to {worst:.3g} {unit} off its plan, {bound}")
            path, world = folder / "figure.png", scenario.scene.world
            console.wrote(ls.view.plot_run(plan, runs, path, world=world, belief=belief))
            misses += [f"{reference}: {line}" for line in undisturbed.target.of_plan(undisturbed.goal_radius)[1:]]
            if video:  # with the calibrated panes that show the robot's position
                run, (quality, fps) = runs["disturbed"], ("draft", 5) if self.quick else ("standard", 30)
                options = {"insets": cameras.measuring(run.plane), "quality": quality, "fps": fps}
                with console.Progress("rendering", "frame") as progress:
                    console.wrote(ls.render(run, folder / "video.mp4", progress=progress, **options))
            if console.wants_result():
                shown = {name: console.of_rollout(run, scenario.problem) for name, run in runs.items()}
                results.append({"solution": console.of_solution(solution), "runs": shown})
        console.say("\n" + "\n".join(rows))
        for line in [*misses, *(f"FAILED {failure}" for failure in failures)]:
            console.say(line)
        console.result(scenarios=results, misses=misses, failures=failures)
        return 1 if failures else 0


TABLE = (
    f"{'scenario':<20} {'run':<12} {'iterations':>10} {'cost':>10} {'gap':>9} {'clearance m':>12}"
    f" {'rms m':>9} {'max m':>9} {'final m':>9} {'goal m':>9} {'outcome':>9}"
)


def _row(reference: str, run: str, solution: "ls.Solution", rollout: "ls.Rollout") -> str:
    error = rollout.tracking_error[0, rollout.counts[0]]
    final, distance = (math.nan, math.nan) if not rollout.counts[0, -1] else (error[-1], rollout.goal_distance[0])
    return (
        f"{reference:<20} {run:<12} {len(solution.iterations):>10} {solution.cost:>10.4f} {solution.gap:>9.1e}"
        f" {rollout.least_clearance()[0]:>12.3f} {math.sqrt((error**2).mean()):>9.2e} {error.max():>9.2e} {final:>9.2e}"
        f" {distance if rollout.target.unit == 'm' else math.nan:>9.2e} {rollout.outcome[0]:>9}"
    )


@dataclass(frozen=True, kw_only=True)
class Cache:
    """Show or clear the cache of compiled solvers.

    The cache holds compiled code and derived formulas. Without it, the solver is compiled again for each number of
    states and controls, in two to five seconds.

    It holds programs, which are loaded and run: do not share the folder with people you do not trust.
    """

    clear: bool = False
    """Remove everything in it."""
    json: Json = False

    def run(self) -> int:
        from lqrsim.codegen import disk_cache

        folder, limit = disk_cache.folder(), disk_cache.LIMIT
        if self.clear:
            try:
                removed = disk_cache.clear()
            except OSError as error:
                raise ls.InputError(f"--clear: got {folder}, want removable files ({error})") from None
            console.say(f"removed {removed} items from {folder}")
            console.result(removed=removed, folder=folder)
            return 0
        items = disk_cache.items()
        groups = itertools.groupby(sorted(items, key=lambda item: item.what), key=lambda item: item.what)
        for kind, alike in sorted(((kind, list(group)) for kind, group in groups), key=lambda pair: -pair[1][0].used):
            used = time.strftime("%Y-%m-%d %H:%M", time.localtime(alike[0].used))
            count = f" ({len(alike)} items)" if len(alike) > 1 else ""
            console.say(f"{sum(item.size for item in alike) / 1e6:8.2f} MB  last used {used}  {kind}{count}")
        total = sum(item.size for item in items) / 1e6
        console.say(f"{len(items)} items, {total:.1f} of at most {limit / 1e6:.0f} MB, in {folder}")
        listed = [{"what": item.what, "size": item.size, "used": item.used} for item in items]
        console.result(items=listed, limit=limit, folder=folder)
        return 0
