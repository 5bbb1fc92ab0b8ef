/*
 * Controller of a quadrotor: @ABOUT@
 *
@IF PLAIN@
 * int @NAME@(const float observation[@SIZE@], float action[4])
 *
 * returns 0, or 1 with an action of zeros if the observation is not finite.
 * Call it @RATE@ times per second.
@END@
@IF MEMORY@
 * struct @NAME@_state { float memory[@UNITS@]; };
 * void @NAME@_reset(struct @NAME@_state *state)
 * int @NAME@_step(struct @NAME@_state *state, const float observation[@SIZE@], float action[4])
 *
 * The policy has a memory. Reset its state at the beginning of a flight, then call the step @RATE@
 * times per second. A step returns 0, or 1 with an action of zeros and the state unchanged if the
 * observation is not finite.
@END@
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

@IF PLAIN@
int @NAME@(const float observation[@SIZE@], float action[4])
@END@
@IF MEMORY@
struct @NAME@_state { float memory[@UNITS@]; };

void @NAME@_reset(struct @NAME@_state *state)
{
    int i;

    for (i = 0; i < @UNITS@; i++)
        state->memory[i] = 0.0f;
}

/* Arguments of gate k (reset, update, candidate) of unit i: from the observation, from memory. */
static float seen(const float *in, int k, int i)
{
    return b[@UNITS@ * k + i] + dot(W + @SIZE@ * (@UNITS@ * k + i), in, @SIZE@);
}

static float kept(const float *memory, int k, int i)
{
    return c[@UNITS@ * k + i] + dot(U + @UNITS@ * (@UNITS@ * k + i), memory, @UNITS@);
}

static float logistic(float x)
{
    return 0.5f * (1.0f + tanhf(0.5f * x));
}

int @NAME@_step(struct @NAME@_state *state, const float observation[@SIZE@], float action[4])
@END@
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
@IF MEMORY@
    for (i = 0; i < @UNITS@; i++) {
        const float *h = state->memory;
        const float r = logistic(seen(in, 0, i) + kept(h, 0, i));
        const float u = logistic(seen(in, 1, i) + kept(h, 1, i));
        const float n = tanhf(seen(in, 2, i) + r * kept(h, 2, i));
        out[i] = n + u * (h[i] - n);
    }
    for (i = 0; i < @UNITS@; i++)
        state->memory[i] = in[@SIZE@ + i] = out[i];
@END@
@LAYERS@    for (i = 0; i < 4; i++)
        action[i] = out[i] < -1.0f ? -1.0f : out[i] > 1.0f ? 1.0f : out[i];
    return 0;
}
