// Linear demosaicing for any filter array: 7x7 weights of each colour for each position of its
// period.
#include "lib/table.h"

INLINE rgb linear_mmse(site at, src_image src, __global const float *weights, uint rows, uint columns) {
    const uint next = columns + TABLE_LANES;
    __global const float *entry = table_at(at, weights, rows, columns, 7 * 7 * 3);
    rgb v = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    UNROLL_ROWS
    for (int dy = -3; dy <= 3; ++dy) {
        for (int dx = -3; dx <= 3; ++dx) {
            const vf sample = src_tap(src, dx, dy);
            v.r += load(entry) * sample;
            v.g += load(entry + next) * sample;
            v.b += load(entry + 2 * next) * sample;
            entry += 3 * next;
        }
    }
    return v;
}
