/* @what@ in C99: @m@ controls from @Y@ measured numbers.
 *
 * Written by lqrsim @version@ from a file whose content has the SHA-256 that is below as MY_POLICY_SHA256.
 * @rounding@
 *
 * Call my_policy_init() at the start, then my_policy_step() in each control period, @period@ s.
 * The plan lasts @horizon@ s. Nothing is allocated. The state of the law is static: one robot runs it. Do not compile it
 * with -ffast-math, for it looks for NaN.
 *
@entries@
 */
#ifndef MY_POLICY_H
#define MY_POLICY_H

#ifdef __cplusplus
extern "C" {
#endif

#define MY_POLICY_SHA256 "@sha256@"
#define MY_POLICY_STEPS @T@ /* laws, one for each control period */
#define MY_POLICY_PERIOD @period@ /* s */
#define MY_POLICY_STATES @n@
#define MY_POLICY_MEASURED @Y@
#define MY_POLICY_CONTROLS @m@
#define MY_POLICY_TABLES @bytes@ /* bytes of the constant tables */

typedef @real@ my_policy_real;

/* Begin a run, the first one or another. */
void my_policy_init(void);

/* The commands at one time.
 *
 * measured: MY_POLICY_MEASURED numbers; angles and rotation vectors in any representative.@lost@
 * t: seconds since the start, 0 or more; a double, so that rounding never puts it into another control period.
 * command: MY_POLICY_CONTROLS numbers, within their limits.
 *
 * After the plan its last law stays in force, about its last state. Returns 0; or 1, and changes nothing, command
 * included, if t is negative, a number is not finite or so large that the law overflows@or@.
 */
int my_policy_step(const my_policy_real *measured, double t, my_policy_real *command);

#ifdef __cplusplus
}
#endif

#endif
