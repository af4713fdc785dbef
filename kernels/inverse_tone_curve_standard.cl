// The inverse of a picture style. Two quadratic equations give the style's mean of the colours, and
// the mean before the curve.
#include "lib/hue.h"

// The colours are t (1 + saturation (x / h - 1)), where h is the mean of the scene's colours x, and
// t is the curve at h. The mean of x / h is 1, which is a quadratic equation in 1 / t.
INLINE rgb inverse_standard(rgb v, site at, float a, float b, float c, float d, float saturation) {
    const rgb y = {clipped_to_1(v.r), clipped_to_1(v.g), clipped_to_1(v.b)};
    const float lost = 1.0f - 1.0f / saturation, gain = 1.0f / saturation;
    const vf sum = (y.r + y.g + y.b) * gain;
    const vf squares = (y.r * y.r + y.g * y.g + y.b * y.b) * (gain * gain);
    const vf middle = (1.0f - 2.0f * lost) * sum;
    const vf below = middle + square_root(vmax(middle * middle - 12.0f * lost * (lost - 1.0f) * squares, (vf)(0.0f)));
    const vf t = clipped_to_1(2.0f * squares / vmax(below, (vf)(1e-12f)));
    const vf quadratic = a - c * t, linear = b - d * t;
    const vf root = square_root(vmax(linear * linear + 4.0f * quadratic * t, (vf)(0.0f)));
    // The form of the root that has no cancellation.
    const vi added = linear > 0.0f;
    const vf over = added ? 2.0f * t : root - linear, under = added ? linear + root : 2.0f * quadratic;
    // White stays white, although the roots are short iterations and the curve is nearly flat there.
    const vf h = t > 0.9999f ? (vf)(1.0f) : over / vmax(under, (vf)(1e-12f));
    const vf factor = gain * (h / vmax(t, (vf)(1e-12f))), grey = lost * h;
    const rgb x = {vmax(y.r * factor + grey, (vf)(0.0f)), vmax(y.g * factor + grey, (vf)(0.0f)),
                   vmax(y.b * factor + grey, (vf)(0.0f))};
    return x;
}
