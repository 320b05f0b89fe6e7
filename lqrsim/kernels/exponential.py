"""exp, computed by arithmetic alone.

Loops over it vectorise, which calls of the C library do not; and its bits are the same with every C library.
"""

from math import floor, inf

from lqrsim.kernels.declarations import exact, power_of_two

LOG2_E = 1.4426950408889634
LN2_HIGH, LN2_LOW = 0.693145751953125, 1.4286068203094173e-06  # ln 2 in two parts; products with the first are exact
LEAST, MOST = -708.0, 709.0  # below, exp x counts as zero; above, as infinite


@exact
def exponential(x):
    """exp x, with a relative error of about 2e-16.

    With k the whole number nearest to x / ln 2 it is 2^k exp r; Taylor's series for r, which is at most 0.35, has an
    error of 1e-17 after the twelfth power.
    """
    k = floor(x * LOG2_E + 0.5)
    r = x - k * LN2_HIGH - k * LN2_LOW
    high = 1 / 5040 + r * (1 / 40320 + r * (1 / 362880 + r * (1 / 3628800 + r * (1 / 39916800 + r / 479001600))))
    series = 1.0 + r * (1.0 + r * (0.5 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720 + r * high))))))
    result = series * power_of_two(k)
    return inf if x > MOST else 0.0 if x < LEAST else result
