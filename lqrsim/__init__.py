"""Feedback policies by iterated LQR smoothing, executed under disturbances in MuJoCo and shown on video.

    import lqrsim as ls

    scenario = ls.scenarios.differential_drive()
    solution = ls.smooth(scenario.problem)
    rollout = ls.simulate(scenario.plant(), solution, disturbances=[ls.ControlNoise(0.05)], seed=0)
    ls.render(rollout, "arena.mp4")

Names are imported when they are first used, so that importing lqrsim costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from lqrsim import robots as robots
    from lqrsim import rotations as rotations
    from lqrsim import scenarios as scenarios
    from lqrsim.checks import DerivativeCheck as DerivativeCheck
    from lqrsim.checks import check_derivatives as check_derivatives
    from lqrsim.constraints import Clearance as Clearance
    from lqrsim.constraints import Constraint as Constraint
    from lqrsim.constraints import Inequalities as Inequalities
    from lqrsim.coordinates import Coordinates as Coordinates
    from lqrsim.costs import ControlCost as ControlCost
    from lqrsim.costs import Cost as Cost
    from lqrsim.costs import FunctionCost as FunctionCost
    from lqrsim.costs import ObstacleCost as ObstacleCost
    from lqrsim.costs import QuadraticCost as QuadraticCost
    from lqrsim.costs import SymbolicCost as SymbolicCost
    from lqrsim.costs import Term as Term
    from lqrsim.dynamics import Dynamics as Dynamics
    from lqrsim.errors import InputError as InputError
    from lqrsim.files import load_rollout as load_rollout
    from lqrsim.files import load_solution as load_solution
    from lqrsim.files import save as save
    from lqrsim.linear_quadratic import Stage as Stage
    from lqrsim.policy import AffinePolicy as AffinePolicy
    from lqrsim.problem import FixedState as FixedState
    from lqrsim.problem import Problem as Problem
    from lqrsim.results import Candidate as Candidate
    from lqrsim.results import Iteration as Iteration
    from lqrsim.results import Multipliers as Multipliers
    from lqrsim.results import Solution as Solution
    from lqrsim.results import Status as Status
    from lqrsim.results import Trajectory as Trajectory
    from lqrsim.robots.base import Robot as Robot
    from lqrsim.robots.differential_drive import DifferentialDrive as DifferentialDrive
    from lqrsim.robots.quadrotor import Quadrotor as Quadrotor
    from lqrsim.rollout import Rollout as Rollout
    from lqrsim.scenarios import Scenario as Scenario
    from lqrsim.scenes import Scene as Scene
    from lqrsim.scenes import load_scene as load_scene
    from lqrsim.simulation.closed_loop import simulate as simulate
    from lqrsim.simulation.controllers import Controller as Controller
    from lqrsim.simulation.controllers import Feedback as Feedback
    from lqrsim.simulation.controllers import Replanning as Replanning
    from lqrsim.simulation.disturbances import ActuatorLoss as ActuatorLoss
    from lqrsim.simulation.disturbances import AxleMismatch as AxleMismatch
    from lqrsim.simulation.disturbances import CommandDropouts as CommandDropouts
    from lqrsim.simulation.disturbances import ControlDelay as ControlDelay
    from lqrsim.simulation.disturbances import ControlNoise as ControlNoise
    from lqrsim.simulation.disturbances import DisplacedObstacles as DisplacedObstacles
    from lqrsim.simulation.disturbances import Disturbance as Disturbance
    from lqrsim.simulation.disturbances import Dryden as Dryden
    from lqrsim.simulation.disturbances import Effect as Effect
    from lqrsim.simulation.disturbances import ForceNoise as ForceNoise
    from lqrsim.simulation.disturbances import FrictionMismatch as FrictionMismatch
    from lqrsim.simulation.disturbances import GilbertElliott as GilbertElliott
    from lqrsim.simulation.disturbances import Gusts as Gusts
    from lqrsim.simulation.disturbances import InertiaMismatch as InertiaMismatch
    from lqrsim.simulation.disturbances import InitialStateError as InitialStateError
    from lqrsim.simulation.disturbances import MassMismatch as MassMismatch
    from lqrsim.simulation.disturbances import MeanWind as MeanWind
    from lqrsim.simulation.disturbances import MeasurementBias as MeasurementBias
    from lqrsim.simulation.disturbances import MeasurementDropouts as MeasurementDropouts
    from lqrsim.simulation.disturbances import MeasurementLatency as MeasurementLatency
    from lqrsim.simulation.disturbances import MeasurementNoise as MeasurementNoise
    from lqrsim.simulation.disturbances import MotorLag as MotorLag
    from lqrsim.simulation.disturbances import Push as Push
    from lqrsim.simulation.disturbances import Saturation as Saturation
    from lqrsim.simulation.disturbances import ThrustMismatch as ThrustMismatch
    from lqrsim.simulation.disturbances import TorqueNoise as TorqueNoise
    from lqrsim.simulation.disturbances import WheelRadiusMismatch as WheelRadiusMismatch
    from lqrsim.simulation.disturbances import preset as preset
    from lqrsim.simulation.outcomes import Outcomes as Outcomes
    from lqrsim.simulation.outcomes import outcomes as outcomes
    from lqrsim.simulation.plant import Plant as Plant
    from lqrsim.simulation.plant_check import PlantCheck as PlantCheck
    from lqrsim.simulation.plant_check import check_plant as check_plant
    from lqrsim.solvers.continuous import ContinuousSolution as ContinuousSolution
    from lqrsim.solvers.continuous import smooth_continuous as smooth_continuous
    from lqrsim.solvers.continuous import smooth_lq_continuous as smooth_lq_continuous
    from lqrsim.solvers.ilqr import ilqr as ilqr
    from lqrsim.solvers.ilqr import ilqr_many as ilqr_many
    from lqrsim.solvers.linear_quadratic import smooth_lq as smooth_lq
    from lqrsim.solvers.smoother import smooth as smooth
    from lqrsim.solvers.smoother import smooth_many as smooth_many
    from lqrsim.solvers.start import InitialPrior as InitialPrior
    from lqrsim.stress.asked import Campaign as Campaign
    from lqrsim.stress.asked import Cell as Cell
    from lqrsim.stress.breaking import smallest_failure as smallest_failure
    from lqrsim.stress.campaign import run_campaign as run_campaign
    from lqrsim.stress.given import TrialScore as TrialScore
    from lqrsim.stress.given import collision as collision
    from lqrsim.stress.given import miss as miss
    from lqrsim.stress.results import Results as Results
    from lqrsim.stress.results import replay as replay
    from lqrsim.stress.splitting import NoFailure as NoFailure
    from lqrsim.stress.splitting import split as split
    from lqrsim.value_functions import Moments as Moments
    from lqrsim.value_functions import Quadratic as Quadratic
    from lqrsim.value_functions import TotalCost as TotalCost
    from lqrsim.verify.drawn import verify_run as verify_run
    from lqrsim.verify.filmed import verify_video as verify_video
    from lqrsim.verify.verdict import Verification as Verification
    from lqrsim.view.plots import plot_run as plot_run
    from lqrsim.view.policy_plot import plot_policy as plot_policy
    from lqrsim.view.render import render as render
    from lqrsim.view.render import still as still
    from lqrsim.view.report import report as report
    from lqrsim.world import Obstacle as Obstacle
    from lqrsim.world import World as World

_HOME = {
    "checks": ["DerivativeCheck", "check_derivatives"],
    "constraints": ["Clearance", "Constraint", "Inequalities"],
    "coordinates": ["Coordinates"],
    "costs": ["ControlCost", "Cost", "FunctionCost", "ObstacleCost", "QuadraticCost", "SymbolicCost", "Term"],
    "dynamics": ["Dynamics"],
    "errors": ["InputError"],
    "files": ["load_rollout", "load_solution", "save"],
    "linear_quadratic": ["Stage"],
    "policy": ["AffinePolicy"],
    "problem": ["FixedState", "Problem"],
    "results": ["Candidate", "Iteration", "Multipliers", "Solution", "Status", "Trajectory"],
    "robots.base": ["Robot"],
    "robots.differential_drive": ["DifferentialDrive"],
    "robots.quadrotor": ["Quadrotor"],
    "rollout": ["Rollout"],
    "scenarios": ["Scenario"],
    "scenes": ["Scene", "load_scene"],
    "simulation.closed_loop": ["simulate"],
    "simulation.controllers": ["Controller", "Feedback", "Replanning"],
    "simulation.disturbances": [
        "ActuatorLoss",
        "AxleMismatch",
        "CommandDropouts",
        "ControlDelay",
        "ControlNoise",
        "DisplacedObstacles",
        "Disturbance",
        "Dryden",
        "Effect",
        "ForceNoise",
        "FrictionMismatch",
        "GilbertElliott",
        "Gusts",
        "InertiaMismatch",
        "InitialStateError",
        "MassMismatch",
        "MeanWind",
        "MeasurementBias",
        "MeasurementDropouts",
        "MeasurementLatency",
        "MeasurementNoise",
        "MotorLag",
        "Push",
        "Saturation",
        "ThrustMismatch",
        "TorqueNoise",
        "WheelRadiusMismatch",
        "preset",
    ],
    "simulation.outcomes": ["Outcomes", "outcomes"],
    "simulation.plant": ["Plant"],
    "simulation.plant_check": ["PlantCheck", "check_plant"],
    "solvers.continuous": ["ContinuousSolution", "smooth_continuous", "smooth_lq_continuous"],
    "solvers.ilqr": ["ilqr", "ilqr_many"],
    "solvers.linear_quadratic": ["smooth_lq"],
    "solvers.smoother": ["smooth", "smooth_many"],
    "solvers.start": ["InitialPrior"],
    "stress.asked": ["Campaign", "Cell"],
    "stress.breaking": ["smallest_failure"],
    "stress.campaign": ["run_campaign"],
    "stress.given": ["TrialScore", "collision", "miss"],
    "stress.results": ["Results", "replay"],
    "stress.splitting": ["NoFailure", "split"],
    "value_functions": ["Moments", "Quadratic", "TotalCost"],
    "verify.drawn": ["verify_run"],
    "verify.filmed": ["verify_video"],
    "verify.verdict": ["Verification"],
    "view.plots": ["plot_run"],
    "view.policy_plot": ["plot_policy"],
    "view.render": ["render", "still"],
    "view.report": ["report"],
    "world": ["Obstacle", "World"],
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}
_SUBMODULES = ("robots", "rotations", "scenarios")

__all__ = sorted([*_MODULE_OF, *_SUBMODULES])  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("lqrsim")
    if name in _SUBMODULES:
        return importlib.import_module(f"lqrsim.{name}")
    if name in _MODULE_OF:
        return getattr(importlib.import_module(f"lqrsim.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'lqrsim' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
