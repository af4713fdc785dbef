// Unsharp mask on the root of luma; the ratios of the colours do not change.
#include "lib/roots.h"

// The root of luma, and blue and red over luma, all with the root's offset.
INLINE ycbcr to_root_and_ratios(rgb c, site at, float offset) {
#pragma OPENCL FP_CONTRACT ON
    const vf y = 0.299f * c.r + (0.587f * c.g + (0.114f * c.b + offset));
    const vf luma = vmax(y, (vf)(1e-6f));
    const vf inverse = inverse_root(luma), per_luma = inverse * inverse;
    const ycbcr v = {luma * inverse, (c.b + offset) * per_luma, (c.r + offset) * per_luma};
    return v;
}

INLINE rgb from_root_and_ratios(ycbcr c, site at, float offset) {
#pragma OPENCL FP_CONTRACT ON
    const vf luma = c.y * c.y;
    const vf green = c.cb * (-0.114f * 1.7035775f) + (c.cr * (-0.299f * 1.7035775f) + 1.7035775f);
    const rgb v = {c.cr * luma - offset, green * luma - offset, c.cb * luma - offset};
    return v;
}

// Adds `amount` of the difference from a Gaussian blur, minus `threshold`, and at most `limit`. The
// blur uses every `step`-th pixel, and weights[k] is the weight of a pixel k steps away. Four rows
// at once share the sums along their rows.
INLINE void unsharp(site at, image planes, int reach, int step, __global const float *weights,
                    float amount, float threshold, float limit, ycbcr *out) {
#pragma OPENCL FP_CONTRACT ON
    vf blurred[4] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
#pragma unroll
    for (int row = -reach * step; row < 4 + reach * step; ++row) {
        vf sum = weights[0] * tap_ycbcr(planes, 0, row).y;
#pragma unroll
        for (int k = 1; k <= reach; ++k) {
            const vf west = tap_ycbcr(planes, -k * step, row).y;
            const vf east = tap_ycbcr(planes, k * step, row).y;
            sum += weights[k] * (west + east);
        }
#pragma unroll
        for (int y = 0; y < 4; ++y) {
            const int away = row < y ? y - row : row - y;
            if (away <= reach * step && away % step == 0) blurred[y] += weights[away / step] * sum;
        }
    }
#pragma unroll
    for (int y = 0; y < 4; ++y) {
        ycbcr c = tap_ycbcr(planes, 0, y);
        const vf detail = c.y - blurred[y];
        const vf size = vmax(magnitude(detail) - threshold, (vf)(0.0f)) * amount;
        const vf change = vmin(size, (vf)(limit));
        c.y = vmax(c.y + (detail < 0.0f ? -change : change), (vf)(0.0f));
        out[y] = c;
    }
}
