// Shot and read noise of a sensor as one heteroscedastic Gaussian, Var[y] = a*y + b (Foi et al.
// 2008, eq. 2), clipped at the full well.
#include "lib/tukey_lambda.h"

INLINE vf sensor_noise(vf y, site at, stream s, float a, float b, float full_well) {
    const vf noise = normal_at(at, 0, s) * square_root(vmax(a * y + b, (vf)(0.0f)));
    return vmin(y + noise, (vf)(full_well));
}

// With read noise of a Tukey lambda distribution.
INLINE vf sensor_noise_tukey(vf y, site at, stream s, float a, float full_well, float read_noise, float shape, float scale) {
    const vf shot = normal_at(at, 0, s) * square_root(vmax(a * y, (vf)(0.0f)));
    const vf read = tukey_lambda_of(word_at(at, 1, s), shape, scale);
    return vmin(y + shot, (vf)(full_well)) + read * read_noise;
}
