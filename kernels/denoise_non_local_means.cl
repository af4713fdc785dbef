// Non-local means (Buades, Coll and Morel 2005) on luma and chroma, patches of 3x3.
#include "lib/patch.h"

// Converts to units in which the squared differences of two patches add up to their squared
// distance.
INLINE ycbcr to_noise_units(rgb c, site at, float luma_unit, float chroma_unit) {
    const ycbcr p = rgb_to_ycbcr(c);
    const float y = 1.0f / luma_unit, c2 = 1.0f / chroma_unit;
    const ycbcr v = {p.y * y, p.cb * c2, p.cr * c2};
    return v;
}

INLINE rgb from_noise_units(ycbcr c, site at, float luma_unit, float chroma_unit) {
    const ycbcr v = {c.y * luma_unit, c.cb * chroma_unit, c.cr * chroma_unit};
    return ycbcr_to_rgb(v);
}

// Squared differences, over all planes, between pixels and those dx, dy away, summed over three
// rows.
INLINE void column_distances(image planes, int dx, int dy, float down[4][WITH_MARGIN * LANES]) {
#pragma OPENCL FP_CONTRACT ON
#pragma unroll
    for (int column = 0; column < WITH_MARGIN; ++column) {
        const int x = column * LANES - 1;
        vf squared[6];
#pragma unroll
        for (int y = 0; y < 6; ++y) {
            const ycbcr one = tap_ycbcr(planes, x, y - 1);
            const ycbcr two = tap_ycbcr(planes, x + dx, y - 1 + dy);
            const vf d = one.y - two.y, b = one.cb - two.cb, r = one.cr - two.cr;
            squared[y] = d * d + b * b + r * r;
        }
#pragma unroll
        for (int y = 0; y < 4; ++y)
            spill(squared[y] + squared[y + 1] + squared[y + 2], down[y] + column * LANES);
    }
}

INLINE bool inside(int offset, int reach) { return offset >= -reach && offset <= reach; }

// The loops over the window are not unrolled: one iteration is long enough, and all of them would
// not fit into the instruction cache.
INLINE void non_local_means(site at, image planes, int luma_reach, int chroma_reach,
                            float noise_slope, float noise_offset, float luma_bias,
                            float chroma_bias, float luma_scale, float chroma_scale, ycbcr *out) {
#pragma OPENCL FP_CONTRACT ON
    const int reach = luma_reach > chroma_reach ? luma_reach : chroma_reach;
    const int last = last_offset(at, reach);
    const float luma_start = -luma_bias * luma_scale;
    const float chroma_start = -chroma_bias * chroma_scale;
    float down[4][WITH_MARGIN * LANES];
    ycbcr sum[4 * COLUMNS];
    vf luma_weight[4 * COLUMNS], chroma_weight[4 * COLUMNS], per_variance[4 * COLUMNS];
#pragma unroll
    for (int y = 0; y < 4; ++y) {
#pragma unroll
        for (int column = 0; column < COLUMNS; ++column) {
            const int i = y * COLUMNS + column;
            vf level = (vf)(0.0f);
#pragma unroll
            for (int dy = -1; dy <= 1; ++dy) {
#pragma unroll
                for (int dx = -1; dx <= 1; ++dx)
                    level += tap_ycbcr(planes, column * LANES + dx, y + dy).y;
            }
            per_variance[i] = 1.0f / (vmax(level, (vf)(0.0f)) * noise_slope + noise_offset);
            sum[i].y = sum[i].cb = sum[i].cr = luma_weight[i] = chroma_weight[i] = (vf)(0.0f);
        }
    }
#pragma unroll 1
    for (int dy = -reach; dy <= last; ++dy) {
#pragma unroll 1
        for (int dx = -reach; dx <= last; ++dx) {
            column_distances(planes, dx, dy, down);
            const bool luma = inside(dx, luma_reach) && inside(dy, luma_reach);
            const bool chroma = inside(dx, chroma_reach) && inside(dy, chroma_reach);
#pragma unroll
            for (int y = 0; y < 4; ++y) {
#pragma unroll
                for (int column = 0; column < COLUMNS; ++column) {
                    const int i = y * COLUMNS + column;
                    const vf distance = across(down[y] + column * LANES) * per_variance[i];
                    const ycbcr other = tap_ycbcr(planes, column * LANES + dx, y + dy);
                    if (luma) {
                        const vf beyond = luma_start + distance * luma_scale;
                        const vf weight = exp2_of_negative(vmin(beyond, (vf)(0.0f)));
                        sum[i].y += weight * other.y;
                        luma_weight[i] += weight;
                    }
                    if (chroma) {
                        const vf beyond = chroma_start + distance * chroma_scale;
                        const vf weight = exp2_of_negative(vmin(beyond, (vf)(0.0f)));
                        sum[i].cb += weight * other.cb;
                        sum[i].cr += weight * other.cr;
                        chroma_weight[i] += weight;
                    }
                }
            }
        }
    }
#pragma unroll
    for (int i = 0; i < 4 * COLUMNS; ++i) {
        const ycbcr v = {sum[i].y / luma_weight[i], sum[i].cb / chroma_weight[i],
                         sum[i].cr / chroma_weight[i]};
        out[i] = v;
    }
}
