// Colour filter arrays of any period.
#include "lib/table.h"

// The light of each colour that a pixel's filter passes.
INLINE vf filter_array(rgb c, site at, __global const float *responses, uint rows, uint columns) {
    __global const float *entry = table_at(at, responses, rows, columns, 3);
    const uint next = columns + TABLE_LANES;
    return (c.r * load(entry) + c.g * load(entry + next)) + c.b * load(entry + 2 * next);
}

// From a white of 1 to the level of white in each channel, and back. Values above white are
// clipped, like for a Bayer pattern.
INLINE vf white_to_level(vf y, site at, __global const float *factors, uint rows, uint columns) {
    return y * load(table_at(at, factors, rows, columns, 1));
}

INLINE vf level_to_white(vf y, site at, __global const float *factors, uint rows, uint columns) {
    return vmin(y * load(table_at(at, factors, rows, columns, 1)), (vf)(1.0f));
}
