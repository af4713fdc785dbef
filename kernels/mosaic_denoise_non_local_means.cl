// Non-local means (Buades, Coll and Morel 2005) on the mosaic, patches of 3x3. The window is gone
// over in steps of two, so that two patches have the same colours in the same places.

// As the sensor saw it, and back.
INLINE vf without_gains(vf y, site at, cfa pattern, float red_inverse, float blue_inverse) {
    return y * by_site(at, pattern, (vf)(red_inverse), (vf)(1.0f), (vf)(blue_inverse));
}

INLINE vf with_gains(vf y, site at, cfa pattern, float red_gain, float blue_gain) {
    return y * by_site(at, pattern, (vf)(red_gain), (vf)(1.0f), (vf)(blue_gain));
}

// A block of 4 rows and COLUMNS vectors at once, as in denoise_non_local_means.cl: columns of three
// squared differences are written down and then added up from wherever a patch begins.
#define COLUMNS 4
#define WITH_MARGIN (LANES == 1 ? COLUMNS + 2 : COLUMNS + 1)

INLINE void column_distances(image mosaic, int dx, int dy, float down[4][WITH_MARGIN * LANES]) {
#pragma OPENCL FP_CONTRACT ON
#pragma unroll
    for (int column = 0; column < WITH_MARGIN; ++column) {
        const int x = column * LANES - 1;
        vf squared[6];
#pragma unroll
        for (int y = 0; y < 6; ++y) {
            const vf d = tap_mosaic(mosaic, x, y - 1) - tap_mosaic(mosaic, x + dx, y - 1 + dy);
            squared[y] = d * d;
        }
#pragma unroll
        for (int y = 0; y < 4; ++y)
            spill(squared[y] + squared[y + 1] + squared[y + 2], down[y] + column * LANES);
    }
}

// The variance a*y + b of all nine samples of a patch together.
INLINE vf patch_variance(image mosaic, int x, int y, float a, float b) {
#pragma OPENCL FP_CONTRACT ON
    vf light = (vf)(0.0f);
#pragma unroll
    for (int dy = -1; dy <= 1; ++dy) {
#pragma unroll
        for (int dx = -1; dx <= 1; ++dx)
            light += most(tap_mosaic(mosaic, x + dx, y + dy), (vf)(0.0f));
    }
    return light * a + 9.0f * b;
}

INLINE void mosaic_non_local_means(site at, image mosaic, int reach, float a, float b, float bias,
                                   float scale, vf *out) {
#pragma OPENCL FP_CONTRACT ON
    // Columns are counted from a number that only seems to depend on the work item; see
    // denoise_non_local_means.cl.
    const int last = reach + (int)(at.x >> 31);
    float down[4][WITH_MARGIN * LANES];
    vf sum[4 * COLUMNS], weights[4 * COLUMNS], per_variance[4 * COLUMNS];
#pragma unroll
    for (int i = 0; i < 4 * COLUMNS; ++i) {
        const vf variance = patch_variance(mosaic, i % COLUMNS * LANES, i / COLUMNS, a, b);
        per_variance[i] = scale / variance;
        sum[i] = weights[i] = (vf)(0.0f);
    }
    const float start = -bias * scale;
#pragma unroll 1
    for (int dy = -reach; dy <= last; dy += 2) {
#pragma unroll 1
        for (int dx = -reach; dx <= last; dx += 2) {
            column_distances(mosaic, dx, dy, down);
#pragma unroll
            for (int i = 0; i < 4 * COLUMNS; ++i) {
                const int x = i % COLUMNS * LANES, y = i / COLUMNS;
                const float *from = down[y] + x;
                const vf distance = unspill(from) + unspill(from + 1) + unspill(from + 2);
                const vf beyond = start + distance * per_variance[i];
                const vf weight = exp2_of_negative(least(beyond, (vf)(0.0f)));
                sum[i] += weight * tap_mosaic(mosaic, x + dx, y + dy);
                weights[i] += weight;
            }
        }
    }
#pragma unroll
    for (int i = 0; i < 4 * COLUMNS; ++i) out[i] = sum[i] / weights[i];
}
