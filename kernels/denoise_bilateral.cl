// Bilateral filter (Tomasi and Manduchi 1998) on luma and chroma, each with its own range sigma.
// Scales come in as -log2(e) / (2 sigma^2), so that a weight is one power of two.
#include "lib/luma_chroma.h"

// Contraction to fma is allowed here: it rounds only once, and only the raw has to be the same on every
// device. Luma and chroma go through the window one after the other, because both at once need more
// registers than a CPU has.
INLINE ycbcr bilateral(site at, image planes, int luma_reach, int chroma_reach,
                       float spatial_scale, float luma_scale, float chroma_scale) {
#pragma OPENCL FP_CONTRACT ON
    const ycbcr centre = tap_ycbcr(planes, 0, 0);
    ycbcr sum = centre;
    vf luma_weight = (vf)(1.0f), chroma_weight = (vf)(1.0f);
#pragma unroll
    for (int dy = -luma_reach; dy <= luma_reach; ++dy) {
#pragma unroll
        for (int dx = -luma_reach; dx <= luma_reach; ++dx) {
            if (dx == 0 && dy == 0) continue;
            const vf near = (vf)((float)(dx * dx + dy * dy) * spatial_scale);
            const vf y = tap_ycbcr(planes, dx, dy).y;
            const vf d = y - centre.y;
            const vf weight = exp2_of_negative(d * d * luma_scale + near);
            sum.y += weight * y;
            luma_weight += weight;
        }
    }
#pragma unroll
    for (int dy = -chroma_reach; dy <= chroma_reach; ++dy) {
#pragma unroll
        for (int dx = -chroma_reach; dx <= chroma_reach; ++dx) {
            if (dx == 0 && dy == 0) continue;
            const vf near = (vf)((float)(dx * dx + dy * dy) * spatial_scale);
            const ycbcr c = tap_ycbcr(planes, dx, dy);
            const vf db = c.cb - centre.cb, dr = c.cr - centre.cr;
            const vf weight = exp2_of_negative((db * db + dr * dr) * chroma_scale + near);
            sum.cb += weight * c.cb;
            sum.cr += weight * c.cr;
            chroma_weight += weight;
        }
    }
    const ycbcr v = {sum.y / luma_weight, sum.cb / chroma_weight, sum.cr / chroma_weight};
    return v;
}
