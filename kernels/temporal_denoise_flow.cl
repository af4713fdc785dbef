// Recursive mean over frames along an optical flow, in two passes: follow, blend.
#include "lib/gather.h"
#include "temporal_denoise.cl"

#define NOWHERE 1e9f  // of a table: the displacement of pixels that the frame before does not show

// A plane at four neighbours, interpolated.
INLINE vf interpolated(__global const float *plane, uint pitch, const int *start, vf u, vf v) {
    const vf a = gather(plane, start, 0), b = gather(plane, start, 1);
    const vf c = gather(plane + pitch, start, 0), d = gather(plane + pitch, start, 1);
    const vf upper = a + u * (b - a), lower = c + u * (d - c);
    return upper + v * (lower - upper);
}

// The result for the frame before at the place of each pixel, else the pixel itself. `flow` has the
// displacements across, then down, of `rows` rows of `columns`. Those at the right are padding. For
// an image that is larger, as in a check of the kernel, the last row and vector are repeated.
INLINE rgb follow(site at, src_image src, image previous, __global const float *flow, int columns,
                  int rows) {
    const int x = int_min((int)at.x, columns - LANES), y = int_min((int)at.y, rows - 1);
    __global const float *here = flow + (long)y * columns + x;
    const vf across = load(here), down = load(here + (long)rows * columns);
    const vi known = across < NOWHERE;
    vf u, v;
    const vi column = split(known ? across : (vf)(0.0f), iota(), &u);
    const vi row = split(known ? down : (vf)(0.0f), (vi)(previous.row), &v);
    int start[LANES];
    spill_int(row * (vi)((int)previous.pitch) + column, start);
    const rgb before = {interpolated(previous.plane0, previous.pitch, start, u, v),
                        interpolated(previous.plane1, previous.pitch, start, u, v),
                        interpolated(previous.plane2, previous.pitch, start, u, v)};
    const rgb own = src_tap(src, 0, 0);
    const rgb moved = {known ? before.r : own.r, known ? before.g : own.g, known ? before.b : own.b};
    return moved;
}
