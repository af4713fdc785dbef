// Whole photo-electrons, at most the full well, and read noise of variance b (EMVA 1288).
#include "lib/poisson.h"
#include "lib/tukey_lambda.h"

INLINE vf photo_electrons(vf y, site at, stream s, float chi, float full_well) {
    const vf mean = vmax(y, (vf)(0.0f)) * chi;
    return vmin(poisson_of(mean, word_at(at, 0, s)), (vf)(full_well));
}

INLINE vf sensor_noise_poisson(vf y, site at, stream s, float chi, float full_well, float a, float read_noise) {
    return photo_electrons(y, at, s, chi, full_well) * a + normal_at(at, 1, s) * read_noise;
}

INLINE vf sensor_noise_poisson_tukey(vf y, site at, stream s, float chi, float full_well, float a, float read_noise, float shape, float scale) {
    const vf read = tukey_lambda_of(word_at(at, 1, s), shape, scale);
    return photo_electrons(y, at, s, chi, full_well) * a + read * read_noise;
}
