// Means weighted by Tukey's biweight of the difference, on the roots of luma and chroma.
#include "lib/roots.h"
#include "lib/smooth.h"

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

INLINE ycbcr smooth_chroma(site at, image planes) {
    ycbcr v = smooth(at, planes);
    v.y = tap_ycbcr(planes, 0, 0).y;
    return v;
}

// Tukey's biweight, from the squared difference.
INLINE vf biweight_of(vf squared) {
    const vf near = vmax((vf)(1.0f) - squared, (vf)(0.0f));
    return near * near;
}

// Luma from the four adjacent pixels, chroma from four that are `chroma_scale` away along both axes:
// demosaicing has made their noise independent of the centre's. Differences of luma are those of
// binomial means of 3x3 pixels. `grain` is the share of luma that does not change. The difference of
// colours includes that of luma, squared, times `luma_share`.
INLINE ycbcr biweight(site at, image planes, float grain, float luma_share, int chroma_scale) {
#pragma OPENCL FP_CONTRACT ON
    const ycbcr centre = smooth_chroma(at, planes);
    vf columns[3][5];  // sums along rows, in the columns around the pixel
#pragma unroll
    for (int x = 0; x < 3; ++x)
#pragma unroll
        for (int y = x == 1 ? 0 : 1; y < (x == 1 ? 5 : 4); ++y)
            columns[x][y] = binomial(tap_ycbcr(planes, x - 2, y - 2).y, tap_ycbcr(planes, x - 1, y - 2).y,
                                     tap_ycbcr(planes, x, y - 2).y);
    const vf here = binomial(columns[1][1], columns[1][2], columns[1][3]) * 0.0625f;
    vf luma = (vf)(0.0f), luma_weight = (vf)(1.0f);  // the sum is that of weighted differences
    vf blue = (vf)(0.0f), red = (vf)(0.0f), chroma_weight = (vf)(1.0f);
#pragma unroll
    for (int k = 0; k < 4; ++k) {
        const int dx = k == 0 ? -1 : k == 1, dy = k == 2 ? -1 : k == 3;
        const vf d = here - binomial(columns[dx + 1][dy + 1], columns[dx + 1][dy + 2],
                                     columns[dx + 1][dy + 3]) * 0.0625f;
        const vf weight = biweight_of(d * d);
        luma += weight * (centre.y - tap_ycbcr(planes, dx, dy).y);
        luma_weight += weight;
        const int right = k % 2 ? chroma_scale : -chroma_scale, down = k / 2 ? chroma_scale : -chroma_scale;
        const ycbcr c = tap_ycbcr(planes, right, down);
        const vf dl = here - c.y, db = centre.cb - c.cb, dr = centre.cr - c.cr;
        const vf share = biweight_of(luma_share * (dl * dl) + db * db + dr * dr);
        blue += share * db;
        red += share * dr;
        chroma_weight += share;
    }
    const vf of_luma = (1.0f - grain) / luma_weight, of_chroma = 1.0f / chroma_weight;
    const ycbcr v = {centre.y - luma * of_luma, centre.cb - blue * of_chroma,
                     centre.cr - red * of_chroma};
    return v;
}
