// Thermal charge that accumulates during the exposure, minus its mean: each pixel's own charge, and
// its shot noise.
#include "lib/random.h"

// The signal with the pixel's own charge minus the mean, and that charge, both in signal units.
// Over the pixels, the charge has a shifted exponential distribution.
INLINE pair dark_charge(vf y, site at, stream s, float mean, float spread) {
    const vu word = word_at(at, 0, s);
    const vf u = (to_float(signed_bits(word >> (vu)(1u))) + 0.5f) * 4.6566129e-10f;
    const vf more = (vmax(negative_log(u), (vf)(0.0f)) - 1.0f) * spread;
    const pair v = {y + more, vmax(more + mean, (vf)(0.0f))};
    return v;
}

INLINE vf dark_shot_noise(pair v, site at, stream s, float per_electron) {
    return v.first + normal_at(at, 1, s) * square_root(v.second * per_electron);
}
