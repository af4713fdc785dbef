// Colour filter arrays of any period.
#include "lib/table.h"

// The light of each colour that a pixel's filter passes.
INLINE vf filter_array(rgb c, site at, __global const float *responses, uint rows, uint columns) {
    __global const float *own = table_at(at, responses, rows, columns, 3);
    const uint next = columns + TABLE_LANES;
    return (c.r * load(own) + c.g * load(own + next)) + c.b * load(own + 2 * next);
}

// White in each channel, and back. Like for a Bayer pattern, values above white are clipped.
INLINE vf white_to_level(vf y, site at, __global const float *factors, uint rows, uint columns) {
    return y * load(table_at(at, factors, rows, columns, 1));
}

INLINE vf level_to_white(vf y, site at, __global const float *factors, uint rows, uint columns) {
    return vmin(y * load(table_at(at, factors, rows, columns, 1)), (vf)(1.0f));
}
