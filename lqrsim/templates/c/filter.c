/* See my_policy.h. In control period k, about z_k in an undisturbed run, d = z - nominal_k:
 *
 *   innovation = measured - (expected_k + sensor_k d)      zero where the measurement got lost
 *   d = d + correction_k innovation
 *   command = planned_k + gain_k d, within the limits
 *   z = next_k + transition_k d + input_k (command - planned_k)
 *
 * z has the states first, then the actuator outputs if they lag, the states of the disturbances, and the commands that
 * are under way if commands or measurements are late.
 */
#include <math.h>

#include "my_policy.h"

#define SIZE @Z@ /* of z */

typedef my_policy_real real;

@tables@
@nearest@
static real z[SIZE];
static int begun;

void my_policy_init(void)
{
    for (int i = 0; i < SIZE; i++)
        z[i] = NOMINAL(0, i);
    begun = 1;
}

int my_policy_step(const my_policy_real *measured, double t, my_policy_real *command)
{
    real d[SIZE], near[SIZE], after[SIZE], limited[MY_POLICY_CONTROLS];

    if (!begun || !(t >= 0.0) || !isfinite(t))
        return 1;
    for (int i = 0; measured && i < MY_POLICY_MEASURED; i++)
        if (!isfinite(measured[i]))
            return 1;
    /* Rounding must not put a time at a knot before it. */
    const double knot = t / MY_POLICY_PERIOD + 1e-9;
    const int k = knot < MY_POLICY_STEPS - 1 ? (int)knot : MY_POLICY_STEPS - 1;
    (void)k; /* one law may serve all periods */

    for (int i = 0; i < SIZE; i++) {
        near[i] = NOMINAL(k, i);
        d[i] = z[i];
    }
    nearest_state(d, near);
    for (int i = 0; i < SIZE; i++)
        d[i] -= near[i];
    if (measured) {
        real expected_now[MY_POLICY_MEASURED], innovation[MY_POLICY_MEASURED];
        for (int i = 0; i < MY_POLICY_MEASURED; i++) {
            expected_now[i] = EXPECTED(k, i);
            for (int j = 0; j < MY_POLICY_STATES; j++)
                expected_now[i] += SENSOR(k, i, j) * d[j];
            innovation[i] = measured[i];
        }
        nearest_measured(innovation, expected_now);
        for (int i = 0; i < MY_POLICY_MEASURED; i++)
            innovation[i] -= expected_now[i];
        for (int i = 0; i < SIZE; i++)
            for (int j = 0; j < MY_POLICY_MEASURED; j++)
                d[i] += CORRECTION(k, i, j) * innovation[j];
    }
    for (int i = 0; i < MY_POLICY_CONTROLS; i++) {
        real wanted = PLANNED(k, i);
        for (int j = 0; j < SIZE; j++)
            wanted += GAIN(k, i, j) * d[j];
        if (!isfinite(wanted)) /* the measurement is so large that a product overflows */
            return 1;
        limited[i] = wanted < lowest[i] ? lowest[i] : wanted > highest[i] ? highest[i] : wanted;
    }
    for (int i = 0; i < SIZE; i++) {
        after[i] = NEXT(k, i);
        for (int j = 0; j < SIZE; j++)
            after[i] += TRANSITION(k, i, j) * d[j];
        for (int j = 0; j < MY_POLICY_CONTROLS; j++)
            after[i] += INPUT(k, i, j) * (limited[j] - PLANNED(k, j));
        if (!isfinite(after[i]))
            return 1;
    }
    /* Nothing has changed so far. */
    for (int i = 0; i < SIZE; i++)
        z[i] = after[i];
    for (int i = 0; i < MY_POLICY_CONTROLS; i++)
        command[i] = limited[i];
    return 0;
}
