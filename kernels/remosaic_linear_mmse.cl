// From any filter array to a Bayer pattern: 7x7 weights of the resulting colour for each position
// of the period.
#include "lib/table.h"

INLINE vf remosaic(site at, src_image src, __global const float *weights, uint rows, uint columns) {
    const uint next = columns + TABLE_LANES;
    __global const float *entry = table_at(at, weights, rows, columns, 7 * 7);
    vf sum = (vf)(0.0f);
    UNROLL_ROWS
    for (int dy = -3; dy <= 3; ++dy) {
        for (int dx = -3; dx <= 3; ++dx) {
            sum += load(entry) * src_tap(src, dx, dy);
            entry += next;
        }
    }
    return sum;
}
