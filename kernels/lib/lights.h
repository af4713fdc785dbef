// Gains of white balance that a plausible light explains.
#ifndef CLPIPE_LIGHTS_H
#define CLPIPE_LIGHTS_H

INLINE float apart(float ratio) { return ratio < 1.0f ? 1.0f - ratio : ratio - 1.0f; }

INLINE float limited(float gain, float light, float tolerance) {
    const float least = light * (1.0f - tolerance), most = light * (1.0f + tolerance);
    return gain < least ? least : gain > most ? most : gain;
}

// Moves the gains of red and blue to within a tolerance of the nearest light. lights[2 * k] and
// lights[2 * k + 1] are the gains of light k. With a count of 0, nothing changes. Nor do gains of 1,
// which mean that there was no light.
INLINE void limit_to_lights(__global float *estimates, __global const float *lights, int count,
                            float tolerance) {
    if (estimates[0] == 1.0f && estimates[1] == 1.0f) return;
    float least = 3.4e38f;
    int nearest = 0;
    for (int k = 0; k < count; ++k) {
        const float red = apart(estimates[0] / lights[2 * k]);
        const float blue = apart(estimates[1] / lights[2 * k + 1]);
        const float distance = red > blue ? red : blue;
        if (distance < least) {
            least = distance;
            nearest = k;
        }
    }
    for (int c = 0; c < 2 && count > 0; ++c)
        estimates[c] = limited(estimates[c], lights[2 * nearest + c], tolerance);
}

#endif
