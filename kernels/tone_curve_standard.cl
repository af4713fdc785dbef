// A picture style: a rational curve from black to grey and another from grey to white, on the largest and
// the smallest of the three colours; the one between keeps its relative place, which is its hue.
#include "lib/hue.h"

// Both pieces are v (a v + b) / (v (c v + d) + 1), the second of what lacks to white.
INLINE vf standard_of(vf x, float grey, float a, float b, float c, float d, float bright_a, float bright_b,
                      float bright_c, float bright_d) {
#pragma OPENCL FP_CONTRACT ON
    const vi dark = x < grey;
    const vf v = dark ? x : 1.0f - x;
    const vf square = dark ? (vf)(a) : (vf)(bright_a), slope = dark ? (vf)(b) : (vf)(bright_b);
    const vf below_square = dark ? (vf)(c) : (vf)(bright_c), below = dark ? (vf)(d) : (vf)(bright_d);
    const vf y = v * (square * v + slope) / (v * (below_square * v + below) + 1.0f);
    return dark ? y : 1.0f - y;
}

INLINE rgb standard(rgb v, site at, float grey, float a, float b, float c, float d, float bright_a,
                    float bright_b, float bright_c, float bright_d) {
    const extremes x = extremes_of(v);
    const vf low = standard_of(x.low, grey, a, b, c, d, bright_a, bright_b, bright_c, bright_d);
    const vf high = standard_of(x.high, grey, a, b, c, d, bright_a, bright_b, bright_c, bright_d);
    return between_extremes(x, low, high);
}
