// A picture style: a rational curve from black to grey and another from grey to white; see
// clpipe/stages/tone_curve/standard.py.
#ifndef CLPIPE_STYLE_H
#define CLPIPE_STYLE_H

#include "lib/hue.h"

// The pieces are v (a v + b) / (v (c v + d) + 1), the bright one of what lacks to white.
typedef struct {
    float grey, a, b, c, d, bright_a, bright_b, bright_c, bright_d;
} style;

// A value of the curve as a fraction.
typedef struct {
    vf above, below;
} fraction;

INLINE fraction styled(vf x, style s) {
#pragma OPENCL FP_CONTRACT ON
    const vi dark = x < s.grey;
    const vf v = dark ? x : 1.0f - x;
    const vf square = dark ? (vf)(s.a) : (vf)(s.bright_a), slope = dark ? (vf)(s.b) : (vf)(s.bright_b);
    const vf below_square = dark ? (vf)(s.c) : (vf)(s.bright_c);
    const vf below_slope = dark ? (vf)(s.d) : (vf)(s.bright_d);
    const vf above = v * (square * v + slope), below = v * (below_square * v + below_slope) + 1.0f;
    const fraction y = {dark ? above : below - above, below};
    return y;
}

// The darkest colour lies in the middle between the curve's and that of the same ratio to the brightest.
INLINE vf styled_low(vf of_curve, vf low, vf ratio) { return 0.5f * (of_curve + low * ratio); }

#endif
