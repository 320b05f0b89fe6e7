/* The one of the equal rotations (angle + 2 pi k) axis that is nearest to another. Entry `turn`, if it is 0 to 2, is an
 * angle and no part of it. */
static void nearest_rotation(real *x, const real *near, int turn)
{
    real axis[3] = {0}, other[3] = {0}, square = 0, length = 0, along = 0;
    for (int i = 0; i < 3; i++) {
        if (i != turn) {
            axis[i] = x[i];
            other[i] = near[i];
        }
        square += axis[i] * axis[i];
        length += other[i] * other[i];
    }
    const real angle = SQRT(square), distance = SQRT(length);
    /* The identity has every axis: take the one that the other points along. */
    const int small = angle < SMALL;
    for (int i = 0; i < 3; i++) {
        axis[i] = small ? (distance > 0 ? other[i] / distance : 0) : axis[i] / angle;
        along += axis[i] * other[i];
    }
    const real turns = RINT((along - angle) / TURN);
    for (int i = 0; (turns < 0 || turns > 0) && i < 3; i++)
        if (i != turn)
            x[i] = (angle + TURN * turns) * axis[i];
}
