// The inverse of a picture style: the root of a quadratic equation for the largest colour.
#include "lib/style.h"

INLINE rgb inverse_standard(rgb v, site at, float grey, float a, float b, float c, float d, float bright_a,
                            float bright_b, float bright_c, float bright_d, float saturation) {
    const extremes y = extremes_of(v);
    const vi dark = y.high < grey;
    const vf u = dark ? y.high : 1.0f - y.high;
    const vf quadratic = dark ? a - c * u : bright_a - bright_c * u;
    const vf linear = dark ? b - d * u : bright_b - bright_d * u;
    const vf root = square_root(vmax(linear * linear + 4.0f * quadratic * u, (vf)(0.0f)));
    // The form of the root that has no cancellation.
    const vi sum = linear > 0.0f;
    const vf above = sum ? 2.0f * u : root - linear, below = sum ? linear + root : 2.0f * quadratic;
    const vf x = above / vmax(below, (vf)(1e-12f)), high = dark ? x : 1.0f - x;
    const vf part = high / (colourfulness(high, saturation) * vmax(y.high, (vf)(1e-9f)));
    const rgb w = {vmax(high - (y.high - y.inside.r) * part, (vf)(0.0f)),
                   vmax(high - (y.high - y.inside.g) * part, (vf)(0.0f)),
                   vmax(high - (y.high - y.inside.b) * part, (vf)(0.0f))};
    return w;
}
