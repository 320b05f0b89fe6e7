"""A step of dynamics with the last command as their last M states.

`x = (y, z)` with `y' = g(y, u)` and `z' = u`. g is called at its address, with sizes of its own, so that it may be any:
a formula's Runge-Kutta step, a user's function, or MuJoCo's steps. `p` has the addresses below.
"""

from lqrsim.kernels.declarations import M, N, W, at, call, stack, zeros
from lqrsim.kernels.linear_algebra import clear, copy, copy_part

ADVANCE, STEP_JACOBIAN, STEP_CURVATURE, NUMBERS = 0, 1, 2, 3  # of g's functions, and of the numbers that they call p


def advance(x, u, p, h, out):
    """Write the state (N,) after `h` seconds."""
    call(p[ADVANCE], x, u, at(p[NUMBERS]), h, out)
    copy_part(u, 0, out, N - M, M)


def step_jacobian(x, u, p, h, out, jacobian):
    """Write the same step, and its Jacobian [A B] (N, W)."""
    own = stack(N - M, N)
    call(p[STEP_JACOBIAN], x, u, at(p[NUMBERS]), h, out, own)
    write_jacobian(u, own, out, jacobian)


def step_curvature(x, u, p, h, weights, out, jacobian, hessian):
    """Write the same; add the Hessian (W, W) of the next state times weights (N,)."""
    own, curve = stack(N - M, N), zeros(N, N)
    call(p[STEP_CURVATURE], x, u, at(p[NUMBERS]), h, weights, out, own, curve)
    write_jacobian(u, own, out, jacobian)
    for i in range(N):
        row = i if i < N - M else i + M
        for j in range(N):
            column = j if j < N - M else j + M
            hessian[row, column] += curve[i, j]


def write_jacobian(u, own, out, jacobian):
    """Write the last M states, and the Jacobian of all, given that of the others, (N - M, N)."""
    clear(jacobian, N, W)
    for i in range(N - M):
        copy(own[i], N - M, jacobian[i])
        copy_part(own[i], N - M, jacobian[i], N, M)
    for i in range(M):
        out[N - M + i] = u[i]
        jacobian[N - M + i, N + i] = 1.0
