// Means weighted by Tukey's biweight of the difference, on the roots of luma and chroma.
#include "lib/roots.h"

INLINE ycbcr to_root_luma_chroma(rgb c, site at, float offset) {
    return rgb_to_ycbcr(roots_of(c, offset));
}

INLINE rgb from_root_luma_chroma(ycbcr c, site at, float offset) {
    return from_roots(ycbcr_to_rgb(c), offset);
}

// (1 - difference^2)^2, 0 beyond 1.
INLINE vf biweight_of(vf squared) {
    const vf near = vmax((vf)(1.0f) - squared, (vf)(0.0f));
    return near * near;
}

// Luma from the pixels around, chroma from those at the corners and two pixels away, whose own noise
// demosaicing has made differ from the centre's. `grain` is the share of luma that stays as it is.
INLINE ycbcr biweight(site at, image planes, float luma_scale, float chroma_scale, float grain) {
#pragma OPENCL FP_CONTRACT ON
    const ycbcr centre = tap_ycbcr(planes, 0, 0);
    ycbcr sum = centre;
    vf luma_weight = (vf)(1.0f), chroma_weight = (vf)(1.0f);
#pragma unroll
    for (int dy = -2; dy <= 2; ++dy) {
#pragma unroll
        for (int dx = -2; dx <= 2; ++dx) {
            const int distance = dx * dx + dy * dy;
            if (distance == 1 || distance == 2) {
                const vf y = tap_ycbcr(planes, dx, dy).y;
                const vf d = y - centre.y;
                const vf weight = biweight_of(d * d * luma_scale) * (distance == 1 ? 0.5f : 0.25f);
                sum.y += weight * y;
                luma_weight += weight;
            }
            if (distance == 2 || distance == 4) {
                const ycbcr c = tap_ycbcr(planes, dx, dy);
                const vf db = c.cb - centre.cb, dr = c.cr - centre.cr;
                const vf weight = biweight_of((db * db + dr * dr) * chroma_scale) *
                                  (distance == 2 ? 0.6f : 0.45f);
                sum.cb += weight * c.cb;
                sum.cr += weight * c.cr;
                chroma_weight += weight;
            }
        }
    }
    const vf y = sum.y / luma_weight, chroma = 1.0f / chroma_weight;
    const ycbcr v = {y + grain * (centre.y - y), sum.cb * chroma, sum.cr * chroma};
    return v;
}
