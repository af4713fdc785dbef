// Recursive mean over frames, with or without a search for the motion since the frame before.
#include "lib/patch.h"

// What a move costs in units of the squared difference that noise explains: without this, noise
// would choose. The second one is per pixel.
#define MOVE 0.5f
#define MOVE_BY 0.05f

// The offset of a tap in a patch of 3x3, row by row.
#define TAP_X(k) ((k) % 3 - 1)
#define TAP_Y(k) ((k) / 3 - 1)

// The squared difference of two patches over the one that noise explains, which `weights` contain.
INLINE vf patch_difference(const rgb *now, image previous, int dx, int dy, rgb weights) {
    vf red = (vf)(0.0f), green = (vf)(0.0f), blue = (vf)(0.0f);
#pragma unroll
    for (int k = 0; k < 9; ++k) {
        const rgb before = tap_rgb(previous, dx + TAP_X(k), dy + TAP_Y(k));
        const vf r = now[k].r - before.r, g = now[k].g - before.g, b = now[k].b - before.b;
        red += r * r;
        green += g * g;
        blue += b * b;
    }
    return red * weights.r + green * weights.g + blue * weights.b;
}

// The inverse of the squared difference that noise explains in a patch, from the sum of its pixels.
INLINE vf weight_of(vf sum, float slope, float offset) {
    return 1.0f / (vmax(sum, (vf)(0.0f)) * slope + offset);
}

// `kept` is the weight of the frame before where noise explains the difference. It falls to 0 where
// the difference is twice as large as `limit`. Slopes and offsets give the expected difference.
INLINE rgb blend(site at, src_image src, image previous, int radius, float kept, float limit,
                 float red_slope, float red_offset, float green_slope, float green_offset,
                 float blue_slope, float blue_offset) {
    rgb now[9], sum = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
#pragma unroll
    for (int k = 0; k < 9; ++k) {
        now[k] = src_tap(src, TAP_X(k), TAP_Y(k));
        sum.r += now[k].r;
        sum.g += now[k].g;
        sum.b += now[k].b;
    }
    const rgb weights = {weight_of(sum.r, red_slope, red_offset),
                         weight_of(sum.g, green_slope, green_offset),
                         weight_of(sum.b, blue_slope, blue_offset)};
    vf difference = patch_difference(now, previous, 0, 0, weights), least = difference;
    rgb before = tap_rgb(previous, 0, 0);
    if (radius) {
        const int last = last_offset(at, radius);
#pragma unroll 1
        for (int dy = -radius; dy <= last; ++dy) {
#pragma unroll 1
            for (int dx = -radius; dx <= last; ++dx) {
                const vf other = patch_difference(now, previous, dx, dy, weights);
                const vf cost = other + (MOVE + MOVE_BY * (float)(int_max(dx, -dx) + int_max(dy, -dy)));
                const rgb moved = tap_rgb(previous, dx, dy);
                before.r = cost < least ? moved.r : before.r;
                before.g = cost < least ? moved.g : before.g;
                before.b = cost < least ? moved.b : before.b;
                difference = cost < least ? other : difference;
                least = vmin(cost, least);
            }
        }
    }
    const vf alike = vmin(vmax((vf)(2.0f) - difference * limit, (vf)(0.0f)), (vf)(1.0f));
    const vf share = kept * (alike * alike);
    const rgb v = {now[4].r + share * (before.r - now[4].r),
                   now[4].g + share * (before.g - now[4].g),
                   now[4].b + share * (before.b - now[4].b)};
    return v;
}
