// The inverse of the rational curve: the root of a quadratic equation.
#include "lib/hue.h"

INLINE vf inverse_neutral_of(vf y, float a, float b, float c, float d) {
    const vf quadratic = a - c * y, linear = b - d * y;
    const vf root = square_root(vmax(linear * linear + 4.0f * quadratic * y, (vf)(0.0f)));
    return (root - linear) / (2.0f * quadratic);
}

INLINE rgb inverse_neutral(rgb v, site at, float a, float b, float c, float d) {
    const extremes x = extremes_of(v);
    return between_extremes(x, inverse_neutral_of(x.low, a, b, c, d),
                            inverse_neutral_of(x.high, a, b, c, d));
}
