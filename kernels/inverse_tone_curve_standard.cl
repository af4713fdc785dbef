// The inverse of a picture style: of the largest colour the root of a quadratic equation, of the smallest
// by halving.
#include "lib/style.h"

INLINE vf light_of(vf y, float grey_out, style s) {
    const vi dark = y < grey_out;
    const vf v = dark ? y : 1.0f - y;
    const vf quadratic = dark ? s.a - s.c * v : s.bright_a - s.bright_c * v;
    const vf linear = dark ? s.b - s.d * v : s.bright_b - s.bright_d * v;
    const vf root = square_root(vmax(linear * linear + 4.0f * quadratic * v, (vf)(0.0f)));
    // Of the two forms of the root, the one in which nothing cancels.
    const vi sum = linear > 0.0f;
    const vf above = sum ? 2.0f * v : root - linear, below = sum ? linear + root : 2.0f * quadratic;
    const vf x = above / vmax(below, (vf)(1e-12f));
    return dark ? x : 1.0f - x;
}

INLINE rgb inverse_standard(rgb v, site at, float grey_out, float grey, float a, float b, float c, float d,
                            float bright_a, float bright_b, float bright_c, float bright_d) {
    const style s = {grey, a, b, c, d, bright_a, bright_b, bright_c, bright_d};
    const extremes y = extremes_of(v);
    const vf high = light_of(y.high, grey_out, s), ratio = y.high / vmax(high, (vf)(1e-9f));
    vf low = high * 0.5f, step = high * 0.25f;
    for (int k = 0; k < 24; ++k) {
        const fraction own = styled(low, s);
        low = styled_low(own.above / own.below, low, ratio) < y.low ? low + step : low - step;
        step = step * 0.5f;
    }
    return between_extremes(y, low, high);
}
