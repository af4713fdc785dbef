// Square roots of the signal, in which shot noise has the same size at all levels. The offset keeps
// the slope of the root finite at black; noise below it is clipped.
#ifndef CLPIPE_ROOTS_H
#define CLPIPE_ROOTS_H

INLINE vf root_of(vf v, float offset) { return square_root(vmax(v + offset, (vf)(0.0f))); }
INLINE vf from_root(vf s, float offset) {
#pragma OPENCL FP_CONTRACT ON
    const vf root = vmax(s, (vf)(0.0f));  // where a difference of colours is below 0
    return root * root - offset;
}

// Roots in steps of 2^-20, from 0 on. They do not change if they are squared and the root is taken
// again. A result from an image's roots therefore has the same bits as one from its light.
INLINE vf in_steps(vf s) { return (vmax(s, (vf)(0.0f)) + 12.0f) - 12.0f; }

// The root to a thousandth of a step: one more Newton step.
INLINE vf exact_root(vf v, float offset) {
    const vf x = vmax(v + offset, (vf)(0.0f));
    const vf inverse = inverse_root(x), root = x * inverse;
    return in_steps(root + 0.5f * inverse * (x - root * root));
}

INLINE rgb light_to_roots(rgb c, site at, float offset) {
    const rgb v = {exact_root(c.r, offset), exact_root(c.g, offset), exact_root(c.b, offset)};
    return v;
}

INLINE rgb roots_to_light(rgb s, site at, float offset) {
    const rgb v = {from_root(s.r, offset), from_root(s.g, offset), from_root(s.b, offset)};
    return v;
}

#endif
