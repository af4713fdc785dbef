// The mean of an image over a camera's rotation. `turns` has three numbers for each moment: the
// sine, the cosine and 1 minus the cosine of the rotation so far. `x`, `y` is the direction in
// which the image centre moves. `middle_x`, `middle_y` is its distance from the centre of the
// image's first pixel. Positions outside the image are clamped to its edge.
#include "lib/gather.h"

// One plane, if all lanes have the same offset to their positions; `corner` is the pixel before the
// first one's.
INLINE vf bilinear_row(__global const float *corner, uint pitch, vf u, vf v) {
    const vf above = (1.0f - u) * load(corner) + u * load(corner + 1);
    const vf below = (1.0f - u) * load(corner + pitch) + u * load(corner + pitch + 1);
    return (1.0f - v) * above + v * below;
}

INLINE rgb turned(site at, __global const float *r, __global const float *g, __global const float *b,
                  extent from, __global const float *turns, uint count, float focal, float x, float y,
                  float middle_x, float middle_y, __global const float *filter) {
    const vf column = to_float(iota() + (vi)((int)at.x));
    const float row = (float)at.y, right = (float)(from.width - 1), bottom = (float)(from.height - 1);
    const vf px = (column - middle_x) / focal;
    const float py = (row - middle_y) / focal;
    const vf along = px * x + py * y, perpendicular = py * x - px * y;
    const int border = (int)from.border;
    rgb sum = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
#pragma unroll 1
    for (uint k = 0; k < count; ++k) {
        const float sine = turns[3 * k], cosine = turns[3 * k + 1], versine = turns[3 * k + 2];
        const vf scale = focal / (cosine + along * sine);
        const vf du = -sine * (1.0f + along * along) * scale;
        const vf dv = perpendicular * (versine - along * sine) * scale;
        const vf across = vmin(vmax(du * x - dv * y, -column), right - column);
        const vf down = vmin(vmax(du * y + dv * x, (vf)(-row)), (vf)(bottom - row));
        vf u, v;
        const vi to_x = split(across, (vi)((int)at.x), &u), to_y = split(down, (vi)((int)at.y), &v);
        int firsts_x[LANES], firsts_y[LANES];
        spill_int(to_x, firsts_x);
        spill_int(to_y, firsts_y);
        const int left = firsts_x[0], top = firsts_y[0];
        if (!any_lane((to_x != left) | (to_y != top)) && left >= (int)from.left - border &&
            left + LANES < (int)(from.left + from.columns) + border &&
            top >= (int)from.top - border && top + 1 < (int)(from.top + from.rows) + border) {
            const long corner = (long)top * (long)from.pitch + left;
            sum.r += bilinear_row(r + corner, from.pitch, u, v);
            sum.g += bilinear_row(g + corner, from.pitch, u, v);
            sum.b += bilinear_row(b + corner, from.pitch, u, v);
        } else {
            // A loop, because three copies of its body take three times as long to compile.
            __global const float *planes[3] = {r, g, b};
            vf channels[3];
#pragma unroll 1
            for (int c = 0; c < 3; ++c) channels[c] = sample_at_offset(at, planes[c], from, across, down, filter, 2, 2);
            sum.r += channels[0];
            sum.g += channels[1];
            sum.b += channels[2];
        }
    }
    const float share = 1.0f / (float)count;
    const rgb mean = {sum.r * share, sum.g * share, sum.b * share};
    return mean;
}
