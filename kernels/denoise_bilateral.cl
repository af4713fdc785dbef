// Bilateral filter (Tomasi and Manduchi 1998) on luma and chroma, each with its own range sigma.
// Differences are those of the guide: the smoothed planes, or the planes. Scales are -log2(e) / (2 sigma^2), so that a weight is one power of two.
#include "lib/luma_chroma.h"
#include "lib/smooth.h"

// A sum of weighted pixels, and of the weights.
typedef struct { ycbcr pixels; vf luma, chroma; } weighted;

// Contraction to fma is allowed here: it rounds only once, and only the raw image must be the same
// on every device.
INLINE void add_luma(weighted *sum, image planes, image guide, vf centre, int dy, int reach, float spatial_scale,
                     float scale) {
#pragma OPENCL FP_CONTRACT ON
#pragma unroll
    for (int dx = -reach; dx <= reach; ++dx) {
        if (dx == 0 && dy == 0) continue;
        const vf near = (vf)((float)(dx * dx + dy * dy) * spatial_scale);
        const vf y = tap_ycbcr(planes, dx, dy).y, d = tap_ycbcr(guide, dx, dy).y - centre;
        const vf weight = exp2_of_negative(d * d * scale + near);
        sum->pixels.y += weight * y;
        sum->luma += weight;
    }
}

INLINE void add_chroma(weighted *sum, image planes, image guide, ycbcr centre, int dy,
                       int reach, float spatial_scale, float scale) {
#pragma OPENCL FP_CONTRACT ON
#pragma unroll
    for (int dx = -reach; dx <= reach; ++dx) {
        if (dx == 0 && dy == 0) continue;
        const vf near = (vf)((float)(dx * dx + dy * dy) * spatial_scale);
        const ycbcr c = tap_ycbcr(planes, dx, dy), other = tap_ycbcr(guide, dx, dy);
        const vf db = other.cb - centre.cb, dr = other.cr - centre.cr;
        const vf weight = exp2_of_negative((db * db + dr * dr) * scale + near);
        sum->pixels.cb += weight * c.cb;
        sum->pixels.cr += weight * c.cr;
        sum->chroma += weight;
    }
}

// The window is traversed for luma and then for chroma, because both at once need more registers
// than a CPU has.
INLINE ycbcr bilateral(site at, image planes, image guide, int luma_reach, int chroma_reach,
                       float spatial_scale, float luma_scale, float chroma_scale) {
    const ycbcr centre = tap_ycbcr(guide, 0, 0);
    weighted sum = {tap_ycbcr(planes, 0, 0), (vf)(1.0f), (vf)(1.0f)};
    UNROLL_ROWS
    for (int dy = -luma_reach; dy <= luma_reach; ++dy)
        add_luma(&sum, planes, guide, centre.y, dy, luma_reach, spatial_scale, luma_scale);
    UNROLL_ROWS
    for (int dy = -chroma_reach; dy <= chroma_reach; ++dy)
        add_chroma(&sum, planes, guide, centre, dy, chroma_reach, spatial_scale, chroma_scale);
    const ycbcr v = {sum.pixels.y / sum.luma, sum.pixels.cb / sum.chroma, sum.pixels.cr / sum.chroma};
    return v;
}

INLINE ycbcr bilateral_by_itself(site at, image planes, int luma_reach, int chroma_reach,
                                 float spatial_scale, float luma_scale, float chroma_scale) {
    return bilateral(at, planes, planes, luma_reach, chroma_reach, spatial_scale, luma_scale,
                     chroma_scale);
}
