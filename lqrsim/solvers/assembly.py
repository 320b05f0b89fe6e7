"""Makes a `Solution` from the result of a run, and says what is doubtful about its plan."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lqrsim.annotations import LINE
from lqrsim.errors import Array, printable
from lqrsim.machine import versions
from lqrsim.problem.obstacles import each_once
from lqrsim.problem.problem import Problem
from lqrsim.results.goal import Target, departure
from lqrsim.results.solution import Solution
from lqrsim.results.solution_parts import Candidate, Iteration, Status, Trajectory, joined
from lqrsim.rotations import AXES, quaternion, rotation_vector
from lqrsim.solvers import compiled
from lqrsim.solvers.certify import LAW, MOTION
from lqrsim.solvers.engine import RunResult, SolveRun
from lqrsim.solvers.settings import can_be_exact

# The policies of plans through contacts are run from this many starts that differ by this much in each state.
NEIGHBOURS, OFFSET = 8, 1e-9
# Distance of a rotation vector from a whole turn, in rad, below which the solution says so. With 0.01 rad of noise, a
# quadrotor that hovers 0.35 rad from there stays level, and one at 0.17 rad tumbles.
NEAR_TURN = 0.3
# That of a tilt from half a turn. An error of the attitude is 2 / NEAR_TILT times as large in the turn, as much as
# 2 pi / NEAR_TURN times in a rotation vector.
NEAR_TILT = 0.1
EXACT = 1e-6  # m or rad, by which a SiteConstraint that is kept may be off
UNBOUNDED = 1e10  # a cost so many times below that of the first iteration, or below -1, falls for ever
UNFINISHED = 0.01  # relative decrease of cost that is still predicted; a plan with more is far from an optimum
TAYLOR = np.array([1.0, 1.0, 1 / 2, 1 / 6, 1 / 24])  # R(z), the factor of a Runge-Kutta step; see `_unstable_step`
# |R(z)| <= 1 for all z of Re z <= 0 within this distance, and on each ray up to one root further away.
STABLE = 2.61
LONGEST = 100_000  # number of shorter steps that are tried
ROUNDING = 1e-6  # of an eigenvalue by MuJoCo's differences, relative to its size: of an oscillation without damping


def assemble(
    run: SolveRun, result: RunResult, *, solver: str, options: dict[str, object],
    candidates: tuple[Candidate, ...] = (),
) -> Solution:  # fmt: skip
    """Copy the result of a run into a Solution."""
    problem, log, result = run.problem, run.budget.log, result.kept()  # what is told of a risk writes to the memory
    assert result.certificate is not None
    if result.status is Status.RISK_TOO_HIGH:
        result = replace(result, detail=_with_risk(run, result))
    falls = bool(log) and result.cost < -UNBOUNDED * max(1.0, abs(log[0].cost))
    if falls and not result.success and result.status is not Status.NOT_POSITIVE_DEFINITE:
        result = replace(result, status=Status.DIVERGED, detail="the cost falls without bound")
    (states, controls), inverse_policy = result.plan, result.values.get("inverse_policy")
    if problem.noise is not None:
        options = options | {"noise": repr(problem.noise), "risk": problem.risk}
    affine = partial(compiled.policy_of, problem)
    unstable, shorter = _unstable_step(problem, states, controls, sound=result.success)
    doubts = (_near_singular(problem, result), _fragile(problem, result)) if np.isfinite(states).all() else ()
    usable, remedy = "", shorter or result.remedy
    if not result.success:
        usable, remedy = _usable(problem, result, options), remedy_of(problem, result, log, options, shorter=shorter)
    said = result.origin, result.detail, usable, *doubts, unstable, _sites(problem, states)
    nominal = states.copy()  # a user may write to the states of the plan, as to convert angles for a plot
    later = {
        "inverse_policy": lambda: None if inverse_policy is None else affine(*inverse_policy, nominal=nominal[1:]),
        "clearance": lambda: clearance_of(problem, nominal),
        "problem_digest": lambda: problem.digest,
        "problem_parts": lambda: parts_of(problem),
    }
    return Solution._assembled(
        later,
        status=result.status,
        detail=joined(*said),
        remedy=remedy,
        policy=affine(*result.policy, nominal[:-1]),
        cost_to_go=result.values.get("cost_to_go"),
        cost_to_come=result.values.get("cost_to_come"),
        trajectory=Trajectory(states, controls, problem.dt),
        iterations=tuple(log),
        certificate=result.certificate,
        gap=result.gap,
        solver=solver,
        options=options,
        multipliers=result.multipliers,
        candidates=candidates,
        versions=versions(),
        goal=problem.weighed_goal,
        goal_radius=goal_radius_of(problem, states),
    )


def _with_risk(run: SolveRun, result: RunResult) -> str:
    """The detail of an answer whose risk was too high: at which step, and which risk is not, if that can be told."""
    work, risk, steps = run.work, run.problem.risk, run.problem.steps
    if not np.isfinite(work.cost):
        work.set_best(work.last)
    if not np.isfinite(work.best.states).all():
        return result.detail
    failed = run.fails_at(risk)
    if failed < 0 or run.fails_at(0.0) >= 0:
        return result.detail
    most = run.largest_risk(risk) * (1 - 1e-5)  # so that even the rounded number works
    too_high = f"about the best plan a risk of {risk:g} is too high at step {failed} of {steps}"
    too_high += f", and at most {most:.5g} will do"
    return joined(too_high, result.detail)


def parts_of(problem: Problem) -> dict[str, str]:
    """What the problem asks for, by part, each as a printable line that a file can hold: it may have a user's repr."""
    return {name: printable(" ".join(text.split()))[: 10 * LINE] for name, text in problem.parts.items() if text}


def _usable(problem: Problem, result: RunResult, options: dict[str, object]) -> str:
    """What the certificate says of a plan for which time or iterations ended, or empty if it misses a constraint."""
    checked, tolerance, allowed = result.certificate, options.get("tolerance"), options.get("constraint_tolerance")
    unfinished = result.status in (Status.TIME_LIMIT, Status.MAX_ITERATIONS)
    if not unfinished or checked is None or not np.isfinite(checked.cost):
        return ""
    missed = checked.violation > (allowed if isinstance(allowed, float) else 0.0)
    sound = checked.dynamics_residual <= MOTION and checked.policy_residual <= LAW
    if missed or checked.start or checked.limits or not sound:
        return ""
    if np.isfinite(checked.optimality) and checked.optimality > UNFINISHED:
        return f"the plan keeps dynamics, limits and constraints, but is far from an optimum ({checked.optimality:.1e})"
    target = Target(problem.dynamics.state_coordinates, problem.weighed_goal, result.states)
    use = "the plan can be used, for it keeps dynamics, limits and constraints"
    if target.misses_goal(target.radius_of_plan(goal_radius_of(problem, result.states))):
        use = "the plan keeps dynamics, limits and constraints, but misses the goal"
    if not np.isfinite(checked.optimality):
        return f"{use}; whether it is optimal is unknown"
    wanted = f", where {tolerance:g} is wanted" if isinstance(tolerance, float) else ""
    return f"{use}; its cost could still fall by a relative {checked.optimality:.1e}{wanted}"


def _sites(problem: Problem, states: Array) -> str:
    """Where the sites of SiteCosts and SiteConstraints end, which a goal of states leaves out; empty if none is off."""
    errors = {name: error[0] for name, error in problem.site_errors(states[-1:]).items()}
    units = {name: "rad" if " turned" in name else "m" for name in errors}
    parts = [f"{name} {error:.3g} {units[name]}" for name, error in errors.items() if error > EXACT]
    return f"sites end off by {', '.join(parts)}, which the goal does not count" if parts else ""


def _near_singular(problem: Problem, result: RunResult) -> str:
    """Where a rotation of the plan is nearly singular, in words; or empty.

    All rotation vectors of whole turns are the same attitude; and a tilt of half a turn is the same attitude in each
    direction, with another turn. Next to them a small error of the attitude is a large one of the states.
    """
    space, states = problem.dynamics.state_coordinates, result.states
    for first, turn in zip(space.rotation_vectors, space.turns, strict=True):
        entries = [first + i for i in range(3) if i != turn]
        period, close, multiple, where = 2 * np.pi, NEAR_TURN, "a whole turn", "rotation vectors"
        if turn >= 0:
            period, close, multiple, where = np.pi, NEAR_TILT, "half or whole turns", "tilts"
        angles = np.linalg.norm(states[:, entries], axis=1)
        turns = np.round(angles / period)
        apart = np.where(turns > 0, np.abs(angles - period * turns), np.inf)
        if apart.min() < close:
            knot, names = int(apart.argmin()), ", ".join(space.names[i] for i in entries)
            axis = _regular_axis(states[:, first : first + 3]) if problem.dynamics.by_mujoco and turn < 0 else None
            return (
                f"at {knot * problem.dt:.4g} s {names} are {apart[knot]:.2g} rad from {multiple}, where {where} are"
                " singular: the policy may take an attitude beside the plan's for another turn"
            ) + (f'; MjcfRobot(..., turns_about="{axis}") avoids this' if axis else "")
    return ""


def _regular_axis(vectors: Array) -> str | None:
    """The axis about which rotation vectors (T+1, 3) are turns with the least tilts; None if a tilt is singular."""
    tilts = {}
    for i, axis in enumerate(AXES):
        turned = rotation_vector(quaternion(vectors), turns_about=axis)
        tilts[axis] = float(np.linalg.norm(np.delete(turned, i, axis=1), axis=1).max())
    axis = min(AXES, key=lambda axis: tilts[axis])
    return axis if tilts[axis] < np.pi - NEAR_TILT else None


def _fragile(problem: Problem, result: RunResult) -> str:
    """Where the policy leaves the plan from a start that differs by rounding, in words; or empty.

    Where a contact begins or ends, a step may jump, and rounding decides which way. Only then is it looked at.
    """
    states, space = result.states, problem.dynamics.state_coordinates
    if not problem.dynamics.touches(states):
        return ""
    for draw in range(NEIGHBOURS):
        signs = np.sign(np.sin(1.0 + (1 + draw) * np.arange(1, len(space) + 1)))
        run, _ = compiled.rollout(problem, *result.policy, states[0] + OFFSET * signs)
        if said := departure(space, run, states, problem.dt):
            return f"from a start that differs by {OFFSET:g} in each state, the policy {said}"
    return ""


def _unstable_step(problem: Problem, states: Array, controls: Array, *, sound: bool) -> tuple[str, str]:
    """What happens at the step at which a plan needs the shortest Runge-Kutta steps, and the remedy; or empty texts.

    A step of h seconds multiplies what has the eigenvalue L of df/dx by R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24, z = hL.
    If it decays, Re L < 0, but |R(z)| > 1, the plan shows an instability of the integrator, not of the system. If the
    plan is not sound, the first such step is reported: what follows may be beyond all bounds because of it. Empty if
    the same controls lead there with shorter steps as well.
    """
    known = np.flatnonzero(np.isfinite(states[:-1]).all(axis=1) & np.isfinite(controls).all(axis=1))
    runge_kutta = problem.dynamics._runge_kutta(states[known], controls[known], problem.dt) if len(known) else None
    if runge_kutta is None:
        return "", ""
    step, slopes = runge_kutta
    # The norm bounds all eigenvalues, and mostly decides.
    with np.errstate(over="ignore"):
        fast = (step * np.linalg.norm(slopes, axis=(1, 2)) > STABLE) & np.isfinite(slopes).all(axis=(1, 2))
    if not fast.any():
        return "", ""
    known, slopes = known[fast], slopes[fast]
    rates = np.linalg.eigvals(slopes)
    excess, reach = np.zeros(rates.shape), step * np.abs(rates)
    for i, j in np.argwhere((reach > STABLE) & (rates.real <= ROUNDING * np.abs(rates))):
        excess[i, j] = reach[i, j] / _reach(complex(rates[i, j]))
    worst = excess.max(axis=1)
    if not (worst > 1).any():
        return "", ""
    knot = int(np.argmax(worst if sound else worst > 1))
    mode = int(np.argmax(excess[knot]))
    rate, t = rates[knot, mode], int(known[knot])
    with np.errstate(over="ignore"):
        growth = abs(np.polyval(TAYLOR[::-1], step * rate))
    shorter = step / float(worst[knot])
    unit = 10.0 ** (math.floor(math.log10(shorter)) - 2)  # of three digits
    longest = math.floor(shorter / unit) * unit
    if not sound and not _stays_finite(problem, states[0], controls, math.ceil(step / longest)):
        return "", ""
    # The state that takes part the most in the eigenvalue, whatever the units of states.
    eigenvalues, right = np.linalg.eig(slopes[knot])
    mode = int(np.argmin(np.abs(eigenvalues - rate)))
    carrier = int(np.argmax(np.abs(np.linalg.pinv(right)[mode] * right[:, mode])))
    name = problem.dynamics.state_coordinates.names[carrier]
    value = f"{rate.real:.3g}" + (f" +- {abs(rate.imag):.3g}i" if rate.imag else "")
    return (
        f"Runge-Kutta steps of {step:g} s are unstable: at {t * problem.dt:g} s (step {t + 1} of"
        f" {problem.steps}) df/dx has the stable eigenvalue {value} 1/s, mostly of {name}, whose deviations a"
        f" step multiplies by {growth:.3g}",
        problem.dynamics._with_finer_steps(step, longest),
    )


def _stays_finite(problem: Problem, start: Array, controls: Array, times: int) -> bool:
    """Whether controls (T, m) lead to finite states if each is held for so many control periods as much shorter.

    Controls that are not finite are the nominal one. True for MuJoCo's steps, and false for more than `LONGEST`.
    """
    steps, n = times * len(controls), len(start)
    if problem.dynamics.by_mujoco or steps > LONGEST:
        return problem.dynamics.by_mujoco
    held = np.repeat(np.where(np.isfinite(controls), controls, problem.nominal_control), times, axis=0)
    gain = np.zeros((steps, held.shape[1], n))
    states, _ = compiled.rollout(problem, gain, held, start, dt=problem.dt / times)
    return bool(np.isfinite(states).all())


def _reach(rate: complex) -> float:
    """The distance from zero, in the direction of an eigenvalue that decays, at which |R(z)| is 1."""
    powers = TAYLOR * (rate / abs(rate)) ** np.arange(5)
    square = np.convolve(powers, powers.conj()).real  # |R|^2 as a polynomial of the distance, the constant first
    square[0] -= 1.0
    roots = np.roots(square[:0:-1])
    return float(roots.real[(np.abs(roots.imag) < ROUNDING) & (roots.real > STABLE)].min(initial=np.inf))


def remedy_of(
    problem: Problem, result: RunResult, log: Sequence[Iteration], options: dict[str, object], *, shorter: str
) -> str:
    """The remedy for a failure, such as `shorter` steps, or else the usual one."""
    status = result.status
    lost = status in (Status.NOT_FINITE, Status.NOT_POSITIVE_DEFINITE, Status.DIVERGED)
    if lost and options.get("safeguard") is False:
        return "solve with safeguard=True, whose steps only lower the cost"
    if shorter or result.remedy:
        return shorter or result.remedy
    if inside := problem.goal_inside:
        geoms = any("geoms" in term.shape for term in problem.kept_clear)
        return f"move the goal, which is {inside}" + ("; or leave that geom out by obstacles=" if geoms else "")
    step, met = problem.dynamics.grazed(result.states) if np.isfinite(result.states).all() else (0, [])
    if met:
        more = {Status.TIME_LIMIT: "; or raise time_limit", Status.MAX_ITERATIONS: "; or raise max_iterations"}
        return (
            f"the plan grazes {' and '.join(met)} at {step * problem.dt:.4g} s: if that is only to be passed, let it"
            f" be among the obstacles= of MjcfRobot, with a clearance{more.get(status, '')}"
        )
    if status is Status.TIME_LIMIT and log:
        took = sum(iteration.seconds for iteration in log)
        similar = "or begin with start=solution of a similar problem"
        return f"raise time_limit: {len(log)} iterations took {took:.2g} s; {similar}"
    if status is Status.MAX_ITERATIONS and log and 0 < log[-1].improvement < np.inf and not result.violation > 0:
        fell = log[-1].improvement * abs(log[-1].cost)
        costs = f"by {fell:.2g}; the plan costs {result.cost:.6g}"
        return f"raise max_iterations: the cost still fell in the last one, {costs}"
    without_exact_finish = options.get("finish", "newton") is None or options["stop"] == "cost"
    space = problem.control_coordinates
    bounded = bool(problem.constraints) or bool(np.isfinite([space.low, space.high]).any())
    helps = status is Status.NOT_POSITIVE_DEFINITE or (bounded and status is not Status.NOT_FINITE)
    if without_exact_finish and can_be_exact(problem) and helps and status is not Status.TIME_LIMIT:
        better = "the interior point" if bounded else "Newton's method"
        how = 'finish="newton" and stop="optimal"' if "form" in options else "smooth"  # iLQR has no finish
        return f"solve with {how}: {better} finds plans where this method does not"
    if status is Status.NOT_FINITE and not np.isfinite(result.states).all():
        begin = "begin with start=[...], controls under which the states stay in their domain"
        return begin if "form" in options else f"solve with smooth, or {begin}"
    if status is Status.INFEASIBLE and result.against:
        relaxed = f"relax {result.against[0].rsplit(' at ', 1)[0]}"
        return f"allow more time than {problem.dt * problem.steps:g} s, {relaxed}, or ask for less of what is missed"
    if status is Status.NOT_POSITIVE_DEFINITE:  # for one, where the stage cost is not curved at the first step
        stage = compiled.compile_problem(problem).stage
        _, _, hessian = compiled.quadratic_at(problem, stage, result.states[0], result.controls[0], 0)
        curved = np.diag(hessian)[result.states.shape[1] :] > 0
        if not curved.all():
            flat = ", ".join(itertools.compress(space.names, ~curved))
            return f"the cost is not curved in {flat}: give control_limits, or add a ControlCost"
    return status.remedy


def goal_radius_of(problem: Problem, plan: Array | None = None) -> float | None:
    """The robot's radius, from its obstacle costs and clearances; None without these, or without a goal position.

    For a plan (T+1, n) that starts near the goal, it is less; see `Target.on_the_way`.
    """
    goal, position = problem.weighed_goal, list(problem.dynamics.state_coordinates.position)
    if not position or (goal is not None and np.isnan(goal[position]).all()):
        return None
    radius = max((term.shape.get("radius", 0.0) for term in problem.kept_clear), default=0.0)
    if plan is not None and radius:
        radius = Target(problem.dynamics.state_coordinates, goal, plan).on_the_way(radius)
    return radius or None


def clearance_of(problem: Problem, states: Array) -> Array | None:
    """Signed distance to the nearest obstacle minus the robot's radius, (T+1,); None without obstacles.

    For a robot of several collision spheres or geoms, it is their smallest distance.
    """
    clearances = []
    for term in each_once([term for term in problem.kept_clear if len(term.world)]):
        shape, displaced = term.in_world(problem.dynamics), None
        if shape.world.moving:
            displaced = shape.world.displacements(problem.times)
        clearances.append(shape.clearance(shape.places(states), displaced))
    return np.min(clearances, axis=0) if clearances else None
