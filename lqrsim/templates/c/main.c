/* Compares commands with those that Python computed from the same numbers, and prints both. Returns 0 if they agree.
 *
 * A robot's own loop has the same two calls: my_policy_init() once, my_policy_step() in each control period.
 */
#include <math.h>
#include <stdio.h>

#include "my_policy.h"

/* For each control: @share@ of the largest sum that makes up its command. */
static const double tolerance[MY_POLICY_CONTROLS] = @tolerance@;

static const struct {
    double t;
    int lost; /* whether the measurement is lost */
    double measured[MY_POLICY_MEASURED], command[MY_POLICY_CONTROLS];
} python[] = {
@rows@
};

int main(void)
{
    int wrong = 0;

    my_policy_init();
    for (int k = 0; k < (int)(sizeof python / sizeof python[0]); k++) {
        my_policy_real measured[MY_POLICY_MEASURED], command[MY_POLICY_CONTROLS];
        for (int i = 0; i < MY_POLICY_MEASURED; i++)
            measured[i] = (my_policy_real)python[k].measured[i];
        if (my_policy_step(python[k].lost ? NULL : measured, python[k].t, command)) {
            printf("t = %.4f s: refused\n", python[k].t);
            return 1;
        }
        printf("t = %.4f s%s\n", python[k].t, python[k].lost ? ", measurement lost" : "");
        for (int i = 0; i < MY_POLICY_CONTROLS; i++) {
            const double here = (double)command[i], off = here - python[k].command[i];
            const int agrees = fabs(off) <= tolerance[i];
            printf("  command %d: %.9g, in Python %.9g%s\n", i, here, python[k].command[i], agrees ? "" : ", WRONG");
            wrong += !agrees;
        }
    }
    printf("%s: %s\n", MY_POLICY_SHA256, wrong ? "WRONG" : "as in Python");
    return wrong != 0;
}
