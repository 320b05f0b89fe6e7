"""What Python calls: one function a solver. The numba subset; see `interface.py`.

All that a solve can need is compiled at once, before it begins, and what its parts share is compiled once.
"""

from lqrsim.kernels.certificate import certify
from lqrsim.kernels.damped_iterations import damped_iterations
from lqrsim.kernels.interface import CERTIFY, DAMP, EVALUATE
from lqrsim.kernels.iterations import ilqr_iterations, smoother_iterations


def smoother(
    task, steps, first, last, max_iterations, tolerance, gap_tolerance, optimal, fixed, guided,
    start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
    eased, prior_weight, prior_about, prior_iterations, guess_x, guess_u, plan_x, plan_u,
    states, controls, kept_L, kept_l, memory, log,
):  # fmt: skip
    """Undamped or damped iterations; or the certificate of `states`, `controls`, `kept_L` and `kept_l`, in log[0].

    To evaluate is to certify with Hessians of the policy's own, which take the place of S.
    """
    if task >= CERTIFY:
        own = task == EVALUATE
        certify(steps, fixed, own, states, controls, kept_L, kept_l, S, p, dt, initial, stage, final, log[0])
        return 0, 0, False, -1
    if task == DAMP:
        return damped_iterations(
            steps, first, last, max_iterations, tolerance, gap_tolerance, optimal, fixed,
            start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
            prior_weight, prior_about, plan_x, plan_u, states, controls, memory, log,
        )  # fmt: skip
    return smoother_iterations(
        steps, first, last, max_iterations, tolerance, gap_tolerance, optimal, fixed, guided,
        start, x_hat, x_hats, L, l, S, s, k, C, b, kbar, G, a, Lbar, lbar, p, dt, initial, stage, final,
        eased, prior_weight, prior_about, prior_iterations, guess_x, guess_u, plan_x, plan_u,
        states, controls, kept_L, kept_l, memory, log,
    )  # fmt: skip


def ilqr(
    task, steps, first, last, max_iterations, tolerance, optimal,
    x0, L, l, S, s, k, p, dt, initial, stage, final,
    states, controls, new_states, new_controls, damping, log,
):  # fmt: skip
    """Iterations of iLQR; or the certificate of `states`, `controls`, `L` and `l`, in log[0]; see `smoother`."""
    if task >= CERTIFY:
        own = task == EVALUATE
        certify(steps, True, own, states, controls, L, l, S, p, dt, initial, stage, final, log[0])
        return 0, 0, False, -1
    return ilqr_iterations(
        steps, first, last, max_iterations, tolerance, optimal,
        x0, L, l, S, s, k, p, dt, initial, stage, final,
        states, controls, new_states, new_controls, damping, log,
    )  # fmt: skip
