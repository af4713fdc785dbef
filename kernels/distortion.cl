// A warped image: each channel of a pixel is sampled with a filter at its position in the input.
// The map of positions is on a grid whose nodes are `step` px apart, a power of two, with `share`
// its reciprocal. It is interpolated by cubic polynomials between four nodes. Each node has eight
// numbers, including the offsets across and down of red, green and blue.
//
// `r`, `g`, `b` point to the position of the input's first pixel in each plane. Only * and +,
// so that NumPy gives the same bits. Rows and lanes outside an image or a tile are computed as
// well; their reads are clamped to it.
#include "lib/gather.h"

typedef float8 node __attribute__((aligned(4)));

// The weights of four nodes at 0, 1, 2 and 3 for a position t among them.
#define LAGRANGE(type, t, w)                                                                        \
    const type t##1 = t - 1.0f, t##2 = t - 2.0f, t##3 = t - 3.0f;                                   \
    const type w[4] = {t##1 * t##2 * t##3 * -0.16666667f, t * t##2 * t##3 * 0.5f,                   \
                       t * t##1 * t##3 * -0.5f, t * t##1 * t##2 * 0.16666667f};

INLINE uint first_node(uint place, uint step, uint nodes) {
    const uint cell = place / step, last = nodes - 4;
    return cell == 0 ? 0 : cell - 1 < last ? cell - 1 : last;
}

// The offset from each lane's pixel to its position in the input, for each field.
INLINE void offsets_at(site at, __global const float *nodes, uint step, float share, uint across, uint down,
                       vf *offsets) {
    const uint top = first_node(at.y, step, down);
    const float v = (float)(at.y - top * step) * share;
    LAGRANGE(float, v, of_row)
    for (uint lane = 0; lane < LANES; lane += step) {  // once if a block is in one cell
        const uint left = first_node(at.x + lane, step, across);
        float8 lines[4];
#pragma unroll
        for (int k = 0; k < 4; ++k) {
            __global const float *column = nodes + ((size_t)top * across + left + k) * 8;
            const size_t pitch = (size_t)across * 8;
            lines[k] = of_row[0] * *(__global const node *)column +
                       of_row[1] * *(__global const node *)(column + pitch) +
                       of_row[2] * *(__global const node *)(column + pitch * 2) +
                       of_row[3] * *(__global const node *)(column + pitch * 3);
        }
        const vf u = to_float(iota() + (vi)((int)(at.x - left * step))) * share;
        LAGRANGE(vf, u, of_column)
        const vi in_cell = iota() >= (vi)((int)lane);
#define FIELD(number, part)                                                                         \
    {                                                                                               \
        const vf value = of_column[0] * lines[0].part + of_column[1] * lines[1].part +              \
                         of_column[2] * lines[2].part + of_column[3] * lines[3].part;               \
        offsets[number] = lane == 0 ? value : in_cell ? value : offsets[number];                    \
    }
        FIELD(0, s0) FIELD(1, s1) FIELD(2, s2) FIELD(3, s3) FIELD(4, s4) FIELD(5, s5)
#undef FIELD
    }
}

INLINE rgb distortion(site at, __global const float *r, __global const float *g,
                      __global const float *b, extent from, __global const float *nodes, uint step,
                      float share, uint across, uint down, __global const float *filter, int taps,
                      int powers) {
    vf offsets[6];
    offsets_at(at, nodes, step, share, across, down, offsets);
    // A loop, because three copies of its body take three times as long to compile.
    __global const float *planes[3] = {r, g, b};
    vf channels[3];
#pragma unroll 1
    for (int c = 0; c < 3; ++c)
        channels[c] = sample_at_offset(at, planes[c], from, offsets[2 * c], offsets[2 * c + 1], filter, taps, powers);
    const rgb v = {channels[0], channels[1], channels[2]};
    return v;
}
