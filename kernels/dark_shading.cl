// Smooth maps that a sensor adds in the dark. Each is a sum of products of a curve over the rows
// and a curve over the columns. The curves are cubic B-splines of normals. Only * and +, so that
// NumPy gives the same bits.
#include "lib/random.h"

INLINE vf knot(vu place, uint curve, stream s) { return normal_of(philox(place, 0, curve, s).word0); }

INLINE vf curve_of_lines(vu line, stream s, uint curve, float per_px) {
    const vf t = to_float(signed_bits(line)) * per_px;
    const vi whole = to_int(t);
    const vf f = t - to_float(whole), f2 = f * f, f3 = f2 * f, g = 1.0f - f;
    const vu first = LANES_OF(as_uint)(whole);
    const vf sum = knot(first, curve, s) * (g * g * g) +
                   knot(first + (vu)(1u), curve, s) * (3.0f * f3 - 6.0f * f2 + 4.0f) +
                   knot(first + (vu)(2u), curve, s) * (3.0f * f2 + 3.0f * f - 3.0f * f3 + 1.0f) +
                   knot(first + (vu)(3u), curve, s) * f3;
    return sum * 0.24078f;  // for the variance 1: 1 / (6 sqrt(151 / 315))
}

INLINE vf dark_shading(vf y, site at, float slope, float offset, __global const float *rows_0,
                       __global const float *columns_0, __global const float *rows_1,
                       __global const float *columns_1, __global const float *rows_2,
                       __global const float *columns_2, __global const float *rows_3,
                       __global const float *columns_3) {
    const vf iso_map = rows_0[at.y] * load(columns_0 + at.x) + rows_1[at.y] * load(columns_1 + at.x);
    const vf fixed_map = rows_2[at.y] * load(columns_2 + at.x) + rows_3[at.y] * load(columns_3 + at.x);
    return y + (iso_map * slope + fixed_map * offset);
}
