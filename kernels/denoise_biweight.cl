// Means weighted by Tukey's biweight of the difference, on the roots of luma and chroma.
#include "lib/roots.h"

// In units of the difference with weight 0.
INLINE ycbcr roots_to_luma_chroma(rgb c, site at, float luma_range, float chroma_range) {
    const ycbcr v = rgb_to_ycbcr(c);
    const float luma = 1.0f / luma_range, chroma = 1.0f / chroma_range;
    const ycbcr w = {v.y * luma, v.cb * chroma, v.cr * chroma};
    return w;
}

// ycbcr_to_rgb, with the units included in its factors.
INLINE rgb luma_chroma_to_light(ycbcr c, site at, float offset, float luma_range, float chroma_range) {
#pragma OPENCL FP_CONTRACT ON
    const float red = chroma_range * 1.4025246f, blue = chroma_range * 1.7730496f;
    const float green_red = red * (-0.299f * 1.7035775f), green_blue = blue * (-0.114f * 1.7035775f);
    const vf y = c.y * luma_range;
    const rgb v = {c.cr * red + y, c.cb * green_blue + (c.cr * green_red + y), c.cb * blue + y};
    return roots_to_light(v, at, offset);
}

// Luma from adjacent pixels, chroma from eight on a ring: `chroma_scale` away along both axes, or
// one more along one axis. Demosaicing has made their noise independent of the centre's. `grain` is
// the share of luma that does not change, and `guide` the weight of luma in the distance of colours.
// Pixels at the same distance share one weight of luma, which is applied last.
INLINE ycbcr biweight(site at, image planes, float grain, float guide, int chroma_scale) {
#pragma OPENCL FP_CONTRACT ON
    const ycbcr centre = tap_ycbcr(planes, 0, 0);
    vf sums[3] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};  // of weighted differences, by squared distance
    vf weights[3] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    vf blue = (vf)(0.0f), red = (vf)(0.0f), chroma_weight = (vf)(1.0f);
#pragma unroll
    for (int dy = -1; dy <= 1; ++dy) {
#pragma unroll
        for (int dx = -1; dx <= 1; ++dx) {
            const int distance = dx * dx + dy * dy;
            if (distance == 0) continue;
            const vf d = centre.y - tap_ycbcr(planes, dx, dy).y;
            const vf near = vmax((vf)(1.0f) - d * d, (vf)(0.0f)), weight = near * near;
            sums[distance] += weight * d;
            weights[distance] += weight;
            const int reach = distance == 2 ? chroma_scale : chroma_scale + 1;
            const ycbcr c = tap_ycbcr(planes, dx * reach, dy * reach);
            const vf dl = centre.y - c.y, db = centre.cb - c.cb, dr = centre.cr - c.cr;
            const vf alike = vmax((vf)(1.0f) - guide * (dl * dl) - db * db - dr * dr, (vf)(0.0f));
            const vf share = alike * alike;
            blue += share * db;
            red += share * dr;
            chroma_weight += share;
        }
    }
    const vf luma_weight = (vf)(1.0f) + 0.5f * weights[1] + 0.25f * weights[2];
    const vf luma = (1.0f - grain) / luma_weight, chroma = 1.0f / chroma_weight;
    const ycbcr v = {centre.y - (0.5f * sums[1] + 0.25f * sums[2]) * luma, centre.cb - blue * chroma,
                     centre.cr - red * chroma};
    return v;
}
