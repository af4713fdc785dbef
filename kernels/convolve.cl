#include "lib/radius.h"

// A weighted mean of surrounding pixels. Tap k is five numbers: its offset to the right and down,
// and its weights for red, green and blue.
INLINE rgb convolve(site at, src_image src, __global const float *taps, int count) {
    rgb sum = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    for (int k = 0; k < count; ++k) {
        __global const float *tap = taps + 5 * k;
        const rgb c = src_tap(src, (int)tap[0], (int)tap[1]);
        sum.r += tap[2] * c.r;
        sum.g += tap[3] * c.g;
        sum.b += tap[4] * c.b;
    }
    return sum;
}

// A symmetric blur with the same weights along rows and columns. weights[k] is the weight of the
// pixels k to either side. The rows of a work item share their sums along rows.
INLINE rgb blur(site at, src_image src, int reach, __global const float *weights) {
    rgb sum = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
#pragma unroll
    for (int dy = -reach; dy <= reach; ++dy) {
        const rgb c = src_tap(src, 0, dy);
        rgb row = {weights[0] * c.r, weights[0] * c.g, weights[0] * c.b};
#pragma unroll
        for (int k = 1; k <= reach; ++k) {
            const rgb west = src_tap(src, -k, dy), east = src_tap(src, k, dy);
            row.r += weights[k] * (west.r + east.r);
            row.g += weights[k] * (west.g + east.g);
            row.b += weights[k] * (west.b + east.b);
        }
        const float weight = weights[dy < 0 ? -dy : dy];
        sum.r += weight * row.r;
        sum.g += weight * row.g;
        sum.b += weight * row.b;
    }
    return sum;
}

// A blur that grows from the centre to the corners: its share is the squared distance.
INLINE rgb field_blur(site at, src_image src, extent e, int corner_reach,
                      __global const float *corner_weights) {
    const rgb c = src_tap(src, 0, 0), blurred = blur(at, src, corner_reach, corner_weights);
    const vf share = vmin(relative_radius(at, e), (vf)(1.0f));
    const rgb v = {c.r + share * (blurred.r - c.r), c.g + share * (blurred.g - c.g),
                   c.b + share * (blurred.b - c.b)};
    return v;
}
