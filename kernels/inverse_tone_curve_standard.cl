// The inverse of a picture style: on each piece, the root of a quadratic equation.
#include "lib/hue.h"

INLINE vf inverse_standard_of(vf y, float grey, float a, float b, float c, float d, float bright_a,
                              float bright_b, float bright_c, float bright_d) {
    const vi dark = y < grey;
    const vf v = dark ? y : 1.0f - y;
    const vf quadratic = dark ? a - c * v : bright_a - bright_c * v;
    const vf linear = dark ? b - d * v : bright_b - bright_d * v;
    const vf root = square_root(vmax(linear * linear + 4.0f * quadratic * v, (vf)(0.0f)));
    // Of the two forms of the root, the one in which nothing cancels.
    const vi sum = linear > 0.0f;
    const vf above = sum ? 2.0f * v : root - linear, below = sum ? linear + root : 2.0f * quadratic;
    const vf x = above / vmax(below, (vf)(1e-12f));
    return dark ? x : 1.0f - x;
}

INLINE rgb inverse_standard(rgb v, site at, float grey, float a, float b, float c, float d, float bright_a,
                            float bright_b, float bright_c, float bright_d) {
    const extremes x = extremes_of(v);
    return between_extremes(
        x, inverse_standard_of(x.low, grey, a, b, c, d, bright_a, bright_b, bright_c, bright_d),
        inverse_standard_of(x.high, grey, a, b, c, d, bright_a, bright_b, bright_c, bright_d));
}
