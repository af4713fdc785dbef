// Shot and read noise of a sensor as one Gaussian z of variance a*y + b, plus as much of z^2 - 1 as
// gives it the third moment of shot noise (Cornish and Fisher 1938).
#include "lib/tukey_lambda.h"

// The variance that this adds is removed from z's own part, except for its square. With little or no
// read noise, a signal below 0.25 electrons has more skew than this approximation supports.
INLINE vf skewed(vf z, vf y, float a, float b) {
    const vf shot = vmax(a * y, (vf)(0.0f)), variance = vmax(a * y + b, (vf)(1e-30f));
    const vf inverse = inverse_root(variance);
    const vf sigma = variance * inverse;
    const vf skew = vmin(shot * inverse * inverse * (a * 0.16666667f), sigma * 0.33333334f);
    const vf linear = (variance - skew * skew) * inverse;
    return (linear + skew * z) * z - skew;
}

INLINE vf skewed_noise(vf y, site at, stream s, float a, float b, float full_well) {
    return vmin(y + skewed(normal_at(at, 0, s), y, a, b), (vf)(full_well));
}

// With read noise of a Tukey lambda distribution.
INLINE vf skewed_noise_tukey(vf y, site at, stream s, float a, float full_well, float read_noise, float shape, float scale) {
    const vf shot = skewed(normal_at(at, 0, s), y, a, 0.0f);
    const vf read = tukey_lambda_of(word_at(at, 1, s), shape, scale);
    return vmin(y + shot, (vf)(full_well)) + read * read_noise;
}
