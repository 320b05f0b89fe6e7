/* The one of the equal rotations (angle + 2 pi k) axis that is nearest to another. */
static void nearest_rotation(real *x, const real *near)
{
    const real angle = SQRT(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
    const real distance = SQRT(near[0] * near[0] + near[1] * near[1] + near[2] * near[2]);
    /* The identity has every axis: take the one that the other points along. */
    const int small = angle < SMALL;
    real axis[3], along = 0;
    for (int i = 0; i < 3; i++) {
        axis[i] = small ? (distance > 0 ? near[i] / distance : 0) : x[i] / angle;
        along += axis[i] * near[i];
    }
    const real turns = RINT((along - angle) / TURN);
    for (int i = 0; (turns < 0 || turns > 0) && i < 3; i++)
        x[i] = (angle + TURN * turns) * axis[i];
}
