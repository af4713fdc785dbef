// Pixels that jump between two levels. The distance between the levels is fixed for a pixel, and
// the level is random in each frame.
#include "lib/random.h"

INLINE pair telegraph_levels(vf y, site at, stream s, int limit, float scale, float amplitude) {
    const vi bits = signed_bits(word_at(at, 0, s) >> (vu)(1u));
    const vf u = (to_float(bits) + 0.5f) * scale;
    const vf half_step = vmax(negative_log(u), (vf)(0.0f)) * amplitude * 0.5f;
    const pair v = {y, bits < limit ? half_step : (vf)(0.0f)};
    return v;
}

INLINE vf telegraph(pair v, site at, stream s) {
    const vi up = signed_bits(word_at(at, 1, s)) >= 0;
    return up ? v.first + v.second : v.first - v.second;
}
