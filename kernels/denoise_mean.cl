// Mean of a square window of luma and of chroma, blended with the centre.
#include "lib/luma_chroma.h"

// Four rows of one plane; all windows that contain a row of pixels share its sum.
INLINE void box_of_four(__global const float *plane, image i, int reach, float share, vf *out) {
#pragma OPENCL FP_CONTRACT ON
    vf sum[4] = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    const float scale = share / (float)((2 * reach + 1) * (2 * reach + 1));
#pragma unroll
    for (int y = -reach; y < 4 + reach; ++y) {
        vf along = tap_plane(plane, i, -reach, y);
#pragma unroll
        for (int dx = 1 - reach; dx <= reach; ++dx)
            along += tap_plane(plane, i, dx, y);
#pragma unroll
        for (int row = 0; row < 4; ++row)
            if (y >= row - reach && y <= row + reach) sum[row] += along;
    }
#pragma unroll
    for (int row = 0; row < 4; ++row)
        out[row] = sum[row] * scale + tap_plane(plane, i, 0, row) * (1.0f - share);
}

INLINE void mean_filter(site at, image planes, int luma_reach, int chroma_reach, float luma_share,
                        float chroma_share, ycbcr *out) {
    vf y[4], cb[4], cr[4];
    box_of_four(planes.plane0, planes, luma_reach, luma_share, y);
    box_of_four(planes.plane1, planes, chroma_reach, chroma_share, cb);
    box_of_four(planes.plane2, planes, chroma_reach, chroma_share, cr);
#pragma unroll
    for (int row = 0; row < 4; ++row) {
        const ycbcr v = {y[row], cb[row], cr[row]};
        out[row] = v;
    }
}
