// The light that a sensor's filters pass: sums of the bands of a spectrum.
#include "lib/table.h"

// A band's pixels, from consecutive planes or from interleaved bands.
INLINE vf plane_of_floats(__global const float *p, uint band, size_t plane, uint bands) {
    return load(p + band * plane);
}

INLINE vf plane_of_halves(__global const half *p, uint band, size_t plane, uint bands) {
    return load_half(p + band * plane);
}

INLINE vf interleaved_floats(__global const float *p, uint band, size_t plane, uint bands) {
    float values[LANES];
#pragma unroll
    for (uint lane = 0; lane < LANES; ++lane) values[lane] = p[lane * bands + band];
    return unspill(values);
}

// Red, green and blue: the sums with three weights for each band. Or one sum, with the weights of
// the filter at each pixel, which three planes then hold: a mosaic takes its sample from any.
#define SPECTRAL_RESPONSE(LAYOUT, SAMPLE, BAND, EACH)                                       \
    INLINE rgb spectral_response_##LAYOUT(__global const SAMPLE *src, site at, extent e,    \
                                          __global const float *weights, uint bands) {      \
        __global const SAMPLE *p = src + EACH * pixel_number(at, e);                        \
        const size_t plane = (size_t)e.columns * e.rows;                                    \
        rgb sum = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};                                     \
        for (uint band = 0; band < bands; ++band, weights += 3) {                           \
            const vf v = BAND(p, band, plane, bands);                                       \
            sum.r += v * weights[0];                                                        \
            sum.g += v * weights[1];                                                        \
            sum.b += v * weights[2];                                                        \
        }                                                                                   \
        return sum;                                                                         \
    }                                                                                       \
    INLINE rgb site_response_##LAYOUT(__global const SAMPLE *src, site at, extent e,        \
                                      __global const float *weights, uint bands, uint rows, \
                                      uint columns) {                                       \
        __global const SAMPLE *p = src + EACH * pixel_number(at, e);                        \
        __global const float *entry = table_at(at, weights, rows, columns, bands);          \
        const size_t plane = (size_t)e.columns * e.rows;                                    \
        vf sum = (vf)(0.0f);                                                                \
        for (uint band = 0; band < bands; ++band, entry += columns + TABLE_LANES)           \
            sum += BAND(p, band, plane, bands) * load(entry);                               \
        const rgb planes = {sum, sum, sum};                                                 \
        return planes;                                                                      \
    }

SPECTRAL_RESPONSE(float_planes, float, plane_of_floats, 1)
SPECTRAL_RESPONSE(half_planes, half, plane_of_halves, 1)
SPECTRAL_RESPONSE(float, float, interleaved_floats, bands)
