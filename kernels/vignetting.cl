// Light that decreases towards the corners.
#include "lib/radius.h"

INLINE rgb times(rgb c, vf gain) {
    const rgb v = {c.r * gain, c.g * gain, c.b * gain};
    return v;
}

// r is 1 at the corner pixel.
INLINE rgb vignetting_pa(rgb c, site at, extent e, float k1, float k2, float k3) {
    const vf r2 = relative_radius(at, e);
    return times(c, vmax(((r2 * k3 + k2) * r2 + k1) * r2 + 1.0f, (vf)(0.0f)));
}

// r is the tangent of the angle to the axis, so 1 / (1 + r^2) is its cosine squared. `per_px` is
// set for a focal length in px, and `per_side` for one in longer sides; the other one is 0.
INLINE rgb vignetting_cosine(rgb c, site at, extent e, float x, float y, float per_px, float per_side) {
    const float side = (float)(e.width > e.height ? e.width : e.height);
    const vf unit = per_px > 0.0f ? (vf)(per_px) : (vf)(per_side) * reciprocal((vf)(side * side));
    const vf cosine = reciprocal(squared_radius(at, x, y) * unit + 1.0f);
    return times(c, cosine * cosine);
}
