// Non-local means (Buades, Coll and Morel 2005) on the mosaic, patches of 3x3. Offsets in the
// window are even, so that two patches have the same colours in the same positions.
#include "lib/patch.h"

// The first plane is the sensor's sample. Patches are compared in the second plane, a function of
// the sample whose noise has the same variance at all levels (generalized Anscombe transform;
// Murtagh, Starck and Bijaoui 1995). It is a difference of two roots, written as a quotient that is
// also valid for a = 0.
INLINE pair stabilize(vf y, site at, cfa pattern, float red_inverse, float blue_inverse,
                            float a, float offset, float root_of_offset) {
    const vf signal = y * by_site(at, pattern, (vf)(red_inverse), (vf)(1.0f), (vf)(blue_inverse));
    const vf root = square_root(vmax(a * signal + offset, (vf)(0.0f)));
    // A third of the factor 2, so that the nine squares of a patch add up to their mean.
    const pair v = {signal, signal * 0.6666667f / (root + root_of_offset)};
    return v;
}

INLINE vf with_gains(vf y, site at, cfa pattern, float red_gain, float blue_gain) {
    return y * by_site(at, pattern, (vf)(red_gain), (vf)(1.0f), (vf)(blue_gain));
}

// Squared differences between samples and those dx, dy away, summed over three rows.
INLINE void sample_distances(image samples, int dx, int dy, float down[4][WITH_MARGIN * LANES]) {
#pragma OPENCL FP_CONTRACT ON
#pragma unroll
    for (int column = 0; column < WITH_MARGIN; ++column) {
        const int x = column * LANES - 1;
        vf squared[6];
#pragma unroll
        for (int y = 0; y < 6; ++y) {
            const vf d = tap_pair(samples, x, y - 1).second -
                         tap_pair(samples, x + dx, y - 1 + dy).second;
            squared[y] = d * d;
        }
#pragma unroll
        for (int y = 0; y < 4; ++y)
            spill(squared[y] + squared[y + 1] + squared[y + 2], down[y] + column * LANES);
    }
}

INLINE void mosaic_non_local_means(site at, image samples, int reach, float bias, float scale,
                                   vf *out) {
#pragma OPENCL FP_CONTRACT ON
    const int last = last_offset(at, reach);
    float down[4][WITH_MARGIN * LANES];
    vf sum[4 * COLUMNS], weights[4 * COLUMNS];
#pragma unroll
    for (int i = 0; i < 4 * COLUMNS; ++i) sum[i] = weights[i] = (vf)(0.0f);
    const float start = -bias * scale;
#pragma unroll 1
    for (int dy = -reach; dy <= last; dy += 2) {
#pragma unroll 1
        for (int dx = -reach; dx <= last; dx += 2) {
            sample_distances(samples, dx, dy, down);
#pragma unroll
            for (int i = 0; i < 4 * COLUMNS; ++i) {
                const int x = i % COLUMNS * LANES, y = i / COLUMNS;
                const vf distance = across(down[y] + x);
                const vf beyond = start + distance * scale;
                const vf weight = exp2_of_negative(vmin(beyond, (vf)(0.0f)));
                sum[i] += weight * tap_pair(samples, x + dx, y + dy).first;
                weights[i] += weight;
            }
        }
    }
#pragma unroll
    for (int i = 0; i < 4 * COLUMNS; ++i) out[i] = sum[i] / weights[i];
}
