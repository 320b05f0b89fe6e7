"""What a solver may begin with: nothing, controls, a policy, a trajectory or a solution."""

import hashlib
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lqrsim.errors import Array, InputError, check_array, excerpt
from lqrsim.problem import Problem
from lqrsim.results import AffinePolicy, Quadratic, Solution, Trajectory

# Controls (m,) or (T, m), or what has more to say.
StartLike = npt.ArrayLike | AffinePolicy | Trajectory | Solution | None


@dataclass(frozen=True)
class Start:
    """The beginning of the first pass.

    Attributes:
      gain, offset: (T, m, n) and (T, m), the policy to begin with.
      cost_to_go: what is known of it; None for nothing.
      trajectory: what the first pass linearises about, feasible or not; None to leave that to the policy.
      summary: what a solution's options say of it.
    """

    gain: Array
    offset: Array
    cost_to_go: Quadratic | None
    trajectory: Trajectory | None
    summary: object

    def rolled_out(self, problem: Problem, x: Array) -> "Start":
        """With the trajectory of the policy from a state (n,): what a backward pass that comes first is about.

        Where it leaves all numbers, the last state and control stay: the trajectory need not be feasible.
        """
        states, controls = [x], []
        with np.errstate(all="ignore"):
            for gain, offset in zip(self.gain, self.offset, strict=True):
                control = gain @ states[-1] + offset
                state = (
                    problem.dynamics.step(states[-1], control, problem.dt) if np.isfinite(control).all() else control
                )
                finite = np.isfinite(state).all()
                controls.append(control if finite else controls[-1] if controls else offset)
                states.append(state if finite else states[-1])
        return replace(self, trajectory=Trajectory(np.array(states), np.array(controls), problem.dt))


def resolve(start: StartLike, problem: Problem) -> Start:
    """The beginning that a caller asked for; by default the problem's nominal control, held.

    Raises:
      InputError: it does not fit the problem.
    """
    n, m, steps = len(problem.dynamics.state_coordinates), len(problem.dynamics.control_coordinates), problem.steps
    if isinstance(start, Solution):
        policy, value = resolve(start.policy, problem), start.cost_to_go
        if value is not None:
            hessian = check_array("start: cost_to_go.hessian", value.hessian, (steps + 1, n, n))
            value = Quadratic(hessian, check_array("start: cost_to_go.gradient", value.gradient, (steps + 1, n)),
                              check_array("start: cost_to_go.constant", value.constant, (steps + 1,)))  # fmt: skip
        return Start(policy.gain, policy.offset, value, None, _summary(start, policy.gain, policy.offset))
    if isinstance(start, AffinePolicy):
        gain = check_array("start: gain", start.gain, (steps, m, n))
        offset = check_array("start: offset", start.offset, (steps, m))
        return Start(gain, offset, None, None, _summary(start, gain, offset))
    if isinstance(start, Trajectory):
        states = check_array("start: states", start.states, (steps + 1, n))
        controls = check_array("start: controls", start.controls, (steps, m))
        given = Trajectory(states, controls, problem.dt)
        return Start(np.zeros((steps, m, n)), controls, None, given, _summary(start, states, controls))
    wanted = problem.nominal_control if start is None else start
    got = excerpt(wanted)
    try:
        given = np.array(wanted, dtype=np.float64)
        got = f"shape {given.shape}"
        controls = np.broadcast_to(given, (steps, m))
    except (TypeError, ValueError):
        raise InputError(
            f"start: got {got}, want controls ({m},) or ({steps}, {m}), a Trajectory, an AffinePolicy or a Solution"
        ) from None
    controls = check_array("start", controls, (steps, m))
    summary = controls[0] if (controls == controls[0]).all() else controls
    return Start(np.zeros((steps, m, n)), controls, None, None, summary.tolist())


def _summary(start: object, *arrays: Array) -> str:
    digest = hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays))
    return f"{type(start).__name__} {digest.hexdigest()[:16]}"
