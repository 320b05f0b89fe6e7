"""The functions that Python calls of the methods on states and controls at once.

They are in one module because they share most of their code, which is compiled once for a size.
"""

from lqrsim.kernels.active_set import active_set as active_set
from lqrsim.kernels.interior_point import interior_point as interior_point
from lqrsim.kernels.restoration import restoration as restoration
from lqrsim.kernels.stages import adjoint as adjoint
from lqrsim.kernels.stages import least_curvatures as least_curvatures
from lqrsim.kernels.stages import look as look
from lqrsim.kernels.stages import read_rows as read_rows
from lqrsim.kernels.stages import survey as survey
from lqrsim.kernels.stages import trial as trial
