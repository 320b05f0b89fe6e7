"""Classes of what functions return or take, for annotations, and `source_of`, for costs and constraints of your own."""

from lqrsim.codegen.sources import source_of
from lqrsim.control.chance_constrained import SafePlan
from lqrsim.control.controllers import ControllerRun
from lqrsim.control.replanner import LiveReplanner, ReplanRecord
from lqrsim.control.tubes import Tube
from lqrsim.outlines import Box, Capsule
from lqrsim.problem.collision_shape import SphereCenters
from lqrsim.problem.derivative_check import DerivativeCheck
from lqrsim.problem.parts import ConstraintTerm, CostTerm
from lqrsim.results.certified import Funnel
from lqrsim.results.coordinates import Coordinates
from lqrsim.results.display import DataTable
from lqrsim.results.export_c import ExportedC
from lqrsim.results.policy import OutputFeedbackPolicy
from lqrsim.results.solution import Replan
from lqrsim.results.solution_parts import (
    BetweenKnots,
    Candidate,
    Certificate,
    ContactCertificate,
    Curvature,
    Iteration,
    Moments,
    Multipliers,
    Quadratic,
    TotalCost,
)
from lqrsim.simulation.plant_check import PlantCheck
from lqrsim.solvers.gradients import Gradients
from lqrsim.solvers.prepared import PreparedSolver
from lqrsim.verify import Verification

__all__ = [
    "BetweenKnots", "Box", "Candidate", "Capsule", "Certificate", "ConstraintTerm", "ContactCertificate",
    "ControllerRun", "Coordinates", "CostTerm", "Curvature", "DataTable", "DerivativeCheck", "ExportedC", "Funnel",
    "Gradients", "Iteration", "LiveReplanner", "Moments", "Multipliers", "OutputFeedbackPolicy", "PlantCheck",
    "PreparedSolver", "Quadratic", "Replan", "ReplanRecord", "SafePlan", "SphereCenters", "TotalCost", "Tube",
    "Verification", "source_of",
]  # fmt: skip
