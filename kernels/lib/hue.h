// Curves that keep hues: they are applied to the largest and the smallest of the three colours. The
// middle one keeps its relative position, like in Adobe's DNG software.
#ifndef CLPIPE_HUE_H
#define CLPIPE_HUE_H

typedef struct {
    rgb inside;  // the colour, clipped to 0..1
    vf low, high;
} extremes;

INLINE vf clipped_to_1(vf v) { return vmin(vmax(v, (vf)(0.0f)), (vf)(1.0f)); }

INLINE extremes extremes_of(rgb c) {
    const rgb v = {clipped_to_1(c.r), clipped_to_1(c.g), clipped_to_1(c.b)};
    const extremes x = {v, vmin(vmin(v.r, v.g), v.b), vmax(vmax(v.r, v.g), v.b)};
    return x;
}

INLINE rgb between_extremes(extremes x, vf to_low, vf to_high) {
    const vf slope = (to_high - to_low) / vmax(x.high - x.low, (vf)(1e-6f));
    const rgb v = {to_low + (x.inside.r - x.low) * slope, to_low + (x.inside.g - x.low) * slope,
                   to_low + (x.inside.b - x.low) * slope};
    return v;
}

#endif
