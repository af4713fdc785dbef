// Charge that heat sets free while the shutter is open, less its mean: each pixel's own, and its shot noise.
#include "lib/random.h"

// An exponential distribution of mean 1, less 1.
INLINE vf dark_pattern(vf y, site at, stream s, float spread) {
    const vu word = word_at(at, 0, s);
    const vf u = (to_float(signed_bits(word >> (vu)(1u))) + 0.5f) * 4.6566129e-10f;
    return y + (vmax(negative_log(u), (vf)(0.0f)) - 1.0f) * spread;
}

INLINE vf dark_shot_noise(vf y, site at, stream s, float sigma) { return y + normal_at(at, 1, s) * sigma; }
