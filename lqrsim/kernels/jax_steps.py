"""Runge-Kutta steps that JAX does, one or all of a plan, by one call into Python.

Among the data of the dynamics is the address of the function of `codegen/jax_steps.py` that does them.
"""

from lqrsim.kernels.declarations import HESSIANS, JACOBIANS, STATES, call
from lqrsim.kernels.runge_kutta import state_jacobians as state_jacobians
from lqrsim.kernels.user_functions import rate as rate
from lqrsim.kernels.user_functions import rate_jacobian as rate_jacobian

STEPS = 2  # index of the address in the data: the rates and their Jacobian come first


def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds."""
    call(p[STEPS], STATES, 1, 0, x, u, p, h, out, out, out, out)


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the state (N,) after `h` seconds, and its Jacobian `[A B]` (N, W)."""
    call(p[STEPS], JACOBIANS, 1, 0, x, u, p, h, out, out, jacobian, jacobian)


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """The same, and add the Hessian (W, W) of the next state times weights (N,)."""
    call(p[STEPS], HESSIANS, 1, 0, x, u, p, h, weights, out, jacobian, hessian)


def all_steps(what, steps, states, controls, p, h, costates, arrived, jacobian, hessian):
    """Write the state after each step of a plan, or also its Jacobian, or also add its Hessian: see `STATES`.

    The weights of the next states are costates[1:].
    """
    call(p[STEPS], what, steps, 1, states, controls, p, h, costates, arrived, jacobian, hessian)
