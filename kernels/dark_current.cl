// Thermal charge that accumulates during the exposure, minus its mean: a fixed charge of each
// pixel, and its shot noise.
#include "lib/random.h"

// The signal plus the pixel's deviation from the mean charge, and the pixel's charge, both in
// signal units. The charge has a shifted exponential distribution over the pixels.
INLINE pair dark_charge(vf y, site at, stream s, float mean, float spread) {
    const vu word = word_at(at, 0, s);
    const vf u = (to_float(signed_bits(word >> (vu)(1u))) + 0.5f) * 4.6566129e-10f;
    const vf deviation = (vmax(negative_log(u), (vf)(0.0f)) - 1.0f) * spread;
    const pair v = {y + deviation, vmax(deviation + mean, (vf)(0.0f))};
    return v;
}

INLINE vf dark_shot_noise(pair v, site at, stream s, float per_electron) {
    return v.first + normal_at(at, 1, s) * square_root(v.second * per_electron);
}
