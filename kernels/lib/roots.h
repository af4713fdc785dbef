// Square roots of the signal, in which shot noise has the same size at all levels. The offset keeps the
// slope of the root finite at black; noise that reaches below it is cut.
#ifndef CLPIPE_ROOTS_H
#define CLPIPE_ROOTS_H

INLINE vf root_of(vf v, float offset) { return square_root(vmax(v + offset, (vf)(0.0f))); }
INLINE vf from_root(vf s, float offset) {
#pragma OPENCL FP_CONTRACT ON
    const vf root = vmax(s, (vf)(0.0f));  // where a difference of colours went below 0
    return root * root - offset;
}

INLINE rgb light_to_roots(rgb c, site at, float offset) {
    const rgb v = {root_of(c.r, offset), root_of(c.g, offset), root_of(c.b, offset)};
    return v;
}

INLINE rgb roots_to_light(rgb s, site at, float offset) {
    const rgb v = {from_root(s.r, offset), from_root(s.g, offset), from_root(s.b, offset)};
    return v;
}

// What is left of roots_to_light and light_to_roots, one after the other.
INLINE rgb roots_above_0(rgb s, site at) {
    const rgb v = {vmax(s.r, (vf)(0.0f)), vmax(s.g, (vf)(0.0f)), vmax(s.b, (vf)(0.0f))};
    return v;
}

#endif
