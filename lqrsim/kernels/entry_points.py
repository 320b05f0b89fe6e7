"""What Python calls: one function a solver, and what is wanted on its own. The kernels' subset.

All that a solve can need is compiled at once, before it begins, and what its parts share is compiled once.
"""

from lqrsim.kernels.certificate import certify
from lqrsim.kernels.damped_iterations import damped_iterations
from lqrsim.kernels.declarations import CERTIFY, DAMP, EVALUATE, FINISH
from lqrsim.kernels.iterations import ilqr_iterations, smoother_iterations
from lqrsim.kernels.newton_iterations import newton_iterations
from lqrsim.kernels.passes import opening_pass as opening_pass
from lqrsim.kernels.rollouts import rollout as rollout


def smoother(task, first, last, settings, model, work, memory, log):
    """Undamped, damped or Newton iterations; or the certificate of the rollout and the policy kept.

    To evaluate is to certify with Hessians of the policy's own, which take the place of the cost-to-go's.
    """
    if task >= CERTIFY:
        own = task == EVALUATE
        certify(settings, own, work.rollout, work.kept, work.to_go, model, work.certificate[0])
        return 0, 0, False, -1
    if task == DAMP:
        return damped_iterations(first, last, settings, model, work, memory[0], log)
    if task == FINISH:
        return newton_iterations(first, last, settings, model, work, memory[0], log)
    return smoother_iterations(first, last, settings, model, work, memory[0], log)


def ilqr(task, first, last, settings, model, work, log):
    """Iterations of iLQR; or the certificate of the plan and the policy; see `smoother`."""
    if task >= CERTIFY:
        own = task == EVALUATE
        certify(settings, own, work.plan, work.policy, work.to_go, model, work.certificate[0])
        return 0, 0, False, -1
    return ilqr_iterations(first, last, settings, model, work, log)
