// Recursive mean over frames, with or without a search for the motion since the frame before.
#include "lib/patch.h"

// What a move costs in units of the squared difference that noise explains: without this, noise
// would choose. The second one is per pixel.
#define MOVE 0.5f
#define MOVE_BY 0.05f

// The offset of a tap in a patch of 3x3, row by row.
#define TAP_X(k) ((k) % 3 - 1)
#define TAP_Y(k) ((k) / 3 - 1)

// The squared difference of two patches, and that of their sums, over what noise explains.
typedef struct { vf pixels, sums; } unlike;

// `weights` contain what noise explains.
INLINE unlike patch_difference(const rgb *now, image previous, int dx, int dy, rgb weights) {
    rgb squares = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)}, sum = squares;
#pragma unroll
    for (int k = 0; k < 9; ++k) {
        const rgb before = tap_rgb(previous, dx + TAP_X(k), dy + TAP_Y(k));
        const vf r = now[k].r - before.r, g = now[k].g - before.g, b = now[k].b - before.b;
        squares.r += r * r;
        squares.g += g * g;
        squares.b += b * b;
        sum.r += r;
        sum.g += g;
        sum.b += b;
    }
    const unlike v = {squares.r * weights.r + squares.g * weights.g + squares.b * weights.b,
                      sum.r * sum.r * weights.r + sum.g * sum.g * weights.g + sum.b * sum.b * weights.b};
    return v;
}

// 1 up to the inverse of `limit`, and 0 from twice that.
INLINE vf alike(vf difference, float limit) {
    return vmin(vmax((vf)(2.0f) - difference * limit, (vf)(0.0f)), (vf)(1.0f));
}

// The inverse of the squared difference that noise explains in a patch, from the sum of its pixels.
INLINE vf weight_of(vf sum, float slope, float offset) {
    return 1.0f / (vmax(sum, (vf)(0.0f)) * slope + offset);
}

// `kept` is the weight of the frame before where noise explains the difference of pixels and that of
// sums. It falls to 0 at twice their inverse limits. Slopes and offsets give the expected difference.
INLINE rgb blend(site at, src_image src, image previous, int radius, float kept, float limit,
                 float sum_limit, float red_slope, float red_offset, float green_slope, float green_offset,
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
    unlike difference = patch_difference(now, previous, 0, 0, weights);
    vf least = difference.pixels;
    rgb before = tap_rgb(previous, 0, 0);
    if (radius) {
        const int last = last_offset(at, radius);
#pragma unroll 1
        for (int dy = -radius; dy <= last; ++dy) {
#pragma unroll 1
            for (int dx = -radius; dx <= last; ++dx) {
                const unlike other = patch_difference(now, previous, dx, dy, weights);
                const vf cost = other.pixels + (MOVE + MOVE_BY * (float)(int_max(dx, -dx) + int_max(dy, -dy)));
                const rgb moved = tap_rgb(previous, dx, dy);
                before.r = cost < least ? moved.r : before.r;
                before.g = cost < least ? moved.g : before.g;
                before.b = cost < least ? moved.b : before.b;
                difference.pixels = cost < least ? other.pixels : difference.pixels;
                difference.sums = cost < least ? other.sums : difference.sums;
                least = vmin(cost, least);
            }
        }
    }
    const vf static_share = vmin(alike(difference.pixels, limit), alike(difference.sums, sum_limit));
    const vf share = kept * (static_share * static_share);
    const rgb v = {now[4].r + share * (before.r - now[4].r),
                   now[4].g + share * (before.g - now[4].g),
                   now[4].b + share * (before.b - now[4].b)};
    return v;
}
