/*
 * Controller of a quadrotor: @ABOUT@
 *
 * int @NAME@(const float observation[@SIZE@], float action[4])
 *
 * returns 0, or 1 with an action of zeros if the observation is not finite.
 * Call it @RATE@ times per second.
 *
 * Observation (SI units; I: inertial, east, north, up; B: body, x ahead, y left, z up;
 * values are clipped to the bounds low and high below):
@LINES@
 *
 * Action, each component a in [-1, 1]:
@ACTIONS@
 */

#include <math.h>

@ARRAYS@
/* Four partial sums have smaller rounding errors than one. */
static float dot(const float *w, const float *x, int n)
{
    float s0 = 0.0f, s1 = 0.0f, s2 = 0.0f, s3 = 0.0f;

    for (; n >= 4; n -= 4, w += 4, x += 4) {
        s0 += w[0] * x[0];
        s1 += w[1] * x[1];
        s2 += w[2] * x[2];
        s3 += w[3] * x[3];
    }
    for (; n > 0; n--)
        s0 += *w++ * *x++;
    return (s0 + s1) + (s2 + s3);
}

int @NAME@(const float observation[@SIZE@], float action[4])
{
    float in[@LONGEST@], out[@WIDEST@];
    int i;

    for (i = 0; i < 4; i++)
        action[i] = 0.0f;
    for (i = 0; i < @SIZE@; i++) {
        const float x = observation[i];
        if (!isfinite(x))
            return 1;
        in[i] = x < low[i] ? low[i] : x > high[i] ? high[i] : x;
    }
@IF NORMALIZED@
    for (i = 0; i < @SIZE@; i++) { /* as in training */
        const @KIND@ z = (in[i] - mean[i]) / deviation[i];
        in[i] = (float)(@LIMITED@);
    }
@END@
@LAYERS@    for (i = 0; i < 4; i++)
        action[i] = out[i] < -1.0f ? -1.0f : out[i] > 1.0f ? 1.0f : out[i];
    return 0;
}
