// Errors of the black level: one for each of the four positions of the filter array, in each frame.
#include "lib/random.h"

INLINE vf errors_of_lines(vu line, stream s, uint column, float even, float odd, float sigma) {
    const vu row = line & (vu)(1u);
    const vf bias = row != (vu)(0u) ? (vf)(odd) : (vf)(even);
    return bias + normal_of_line(row + (vu)(2u * column), s) * sigma;
}

INLINE vf black_level_error(vf y, site at, __global const float *in_even, __global const float *in_odd) {
    const vi odd = (iota() + (vi)((int)at.x)) & 1;
    const vf error = odd != 0 ? (vf)(in_odd[at.y]) : (vf)(in_even[at.y]);
    return y + error;
}
