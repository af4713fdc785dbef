// An image through a wide lens: each pixel is sampled with a filter at its position in the input.
// `across` and `down` are the offsets to this position: `lines` rows of `pitch` values. Rows and
// lanes outside the image read the last row and vector.
#include "lib/gather.h"

INLINE rgb projection(site at, __global const float *r, __global const float *g, __global const float *b,
                      extent from, __global const float *across, __global const float *down, uint pitch,
                      uint lines, __global const float *filter, int taps, int powers) {
    const uint row = at.y < lines ? at.y : lines - 1, last = pitch - LANES;
    const size_t here = (size_t)row * pitch + (at.x < last ? at.x : last);
    const vf right = load(across + here), below = load(down + here);
    // A loop, because three copies of its body take three times as long to compile.
    __global const float *planes[3] = {r, g, b};
    vf channels[3];
#pragma unroll 1
    for (int c = 0; c < 3; ++c) channels[c] = sample_at_offset(at, planes[c], from, right, below, filter, taps, powers);
    const rgb v = {channels[0], channels[1], channels[2]};
    return v;
}
