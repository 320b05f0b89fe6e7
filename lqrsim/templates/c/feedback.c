/* See my_policy.h. In control period k: command = planned_k + gain_k (state - nominal_k), within the limits. */
#include <math.h>

#include "my_policy.h"

typedef my_policy_real real;

@tables@
@nearest@
void my_policy_init(void)
{
}

/* Command i by the law of control period k, not limited. */
static real law(int k, int i, const real *state)
{
    (void)k; /* one law may serve all periods */
    real sum = PLANNED(k, i);
    for (int j = 0; j < MY_POLICY_STATES; j++)
        sum += GAIN(k, i, j) * (state[j] - NOMINAL(k, j));
    return sum;
}

int my_policy_step(const my_policy_real *measured, double t, my_policy_real *command)
{
    real state[MY_POLICY_STATES], near[MY_POLICY_STATES], wanted[MY_POLICY_CONTROLS];

    if (!measured || !(t >= 0.0) || !isfinite(t))
        return 1;
    for (int j = 0; j < MY_POLICY_STATES; j++) {
        if (!isfinite(measured[j]))
            return 1;
        state[j] = measured[j];
    }
    /* Rounding must not put a time at a knot before it. */
    const double knot = t / MY_POLICY_PERIOD + 1e-9;
    const int k = knot < MY_POLICY_STEPS - 1 ? (int)knot : MY_POLICY_STEPS - 1;
@blend@
    for (int j = 0; j < MY_POLICY_STATES; j++)
        near[j] = @near@;
    nearest_state(state, near);
    for (int i = 0; i < MY_POLICY_CONTROLS; i++) {
        wanted[i] = @wanted@;
        if (!isfinite(wanted[i])) /* the state is so large that a product overflows */
            return 1;
    }
    for (int i = 0; i < MY_POLICY_CONTROLS; i++)
        command[i] = wanted[i] < lowest[i] ? lowest[i] : wanted[i] > highest[i] ? highest[i] : wanted[i];
    return 0;
}
