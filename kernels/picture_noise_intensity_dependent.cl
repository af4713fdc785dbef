// Gaussian noise, independent in each pixel, with a sigma that follows each channel's intensity by
// a table of 256 entries per channel (SyB3R; Ley, Haensch, Hellwich 2016).
#include "lib/correlated.h"

INLINE vf sigma_at(vf v, __global const float *table) {
    const vi index = to_8_bit(v);
#if LANES == 1
    return table[index];
#else
    int place[LANES];
    float sigma[LANES];
    spill_int(index, place);
    for (int k = 0; k < LANES; ++k) sigma[k] = table[place[k]];
    return unspill(sigma);
#endif
}

INLINE rgb picture_noise(rgb c, site at, stream s, __global const float *sigmas, float green_red,
                         float green_green, float blue_red, float blue_green, float blue_blue) {
    const rgb n = correlated_normals(at, s, green_red, green_green, blue_red, blue_green, blue_blue);
    const rgb v = {c.r + n.r * sigma_at(c.r, sigmas), c.g + n.g * sigma_at(c.g, sigmas + 256),
                   c.b + n.b * sigma_at(c.b, sigmas + 512)};
    return v;
}
