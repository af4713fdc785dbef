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
// the share of luma that does not change. Pixels at the same distance share one weight, which is
// applied last.
INLINE ycbcr biweight(site at, image planes, float grain, int chroma_scale) {
#pragma OPENCL FP_CONTRACT ON
    const ycbcr centre = tap_ycbcr(planes, 0, 0), none = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    ycbcr sums[5] = {none, none, none, none, none};  // of weighted differences, by squared distance
    vf luma_weights[5] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    vf chroma_weights[5] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
#pragma unroll
    for (int dy = -2; dy <= 2; ++dy) {
#pragma unroll
        for (int dx = -2; dx <= 2; ++dx) {
            const int distance = dx * dx + dy * dy;
            if (distance == 1 || distance == 2) {
                const vf d = centre.y - tap_ycbcr(planes, dx, dy).y;
                const vf near = vmax((vf)(1.0f) - d * d, (vf)(0.0f)), weight = near * near;
                sums[distance].y += weight * d;
                luma_weights[distance] += weight;
            }
            if (distance == 2 || distance == 4) {
                const ycbcr c = distance == 2
                                    ? tap_ycbcr(planes, dx * chroma_scale, dy * chroma_scale)
                                    : tap_ycbcr(planes, dx / 2 * (chroma_scale + 1), dy / 2 * (chroma_scale + 1));
                const vf db = centre.cb - c.cb, dr = centre.cr - c.cr;
                const vf near = vmax((vf)(1.0f) - db * db - dr * dr, (vf)(0.0f));
                const vf weight = near * near;
                sums[distance].cb += weight * db;
                sums[distance].cr += weight * dr;
                chroma_weights[distance] += weight;
            }
        }
    }
    const vf luma_weight = (vf)(1.0f) + 0.5f * luma_weights[1] + 0.25f * luma_weights[2];
    const vf chroma_weight = (vf)(1.0f) + 0.4f * chroma_weights[2] + 0.25f * chroma_weights[4];
    const vf luma = (1.0f - grain) / luma_weight, chroma = 1.0f / chroma_weight;
    const ycbcr v = {centre.y - (0.5f * sums[1].y + 0.25f * sums[2].y) * luma,
                     centre.cb - (0.4f * sums[2].cb + 0.25f * sums[4].cb) * chroma,
                     centre.cr - (0.4f * sums[2].cr + 0.25f * sums[4].cr) * chroma};
    return v;
}
