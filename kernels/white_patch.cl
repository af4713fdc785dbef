#include "site_gains.cl"
#include "lib/lights.h"
// White patch: gains that make the brightest samples of the three colours equal. Each colour has a
// histogram, 12 octaves below 1 with 512 bins each, indexed by the upper bits of the float.
#define WHITE_PATCH_BINS 6144

// The bin of a pixel, or -1 if its 2x2 cell has a clipped sample, since the colour of a clipped
// light is unknown. The last column or row of an image of odd size is its own cell.
INLINE int white_patch_bin(__global const float *origin, uint x, uint y, extent e, cfa pattern,
                           float clip) {
    const uint left = x & ~1u, right = left + 1 < e.width ? left + 1 : left;
    const uint top = y & ~1u, bottom = top + 1 < e.height ? top + 1 : top;
    __global const float *upper = origin + (size_t)top * e.pitch;
    __global const float *lower = origin + (size_t)bottom * e.pitch;
    if (upper[left] >= clip || upper[right] >= clip || lower[left] >= clip || lower[right] >= clip)
        return -1;
    const uint off_red = ((x ^ pattern.red_x) & 1) + ((y ^ pattern.red_y) & 1);
    const float sample = origin[(size_t)y * e.pitch + x];
    const float inside = sample > 0x1p-12f ? sample : 0x1p-12f;
    return (int)off_red * WHITE_PATCH_BINS + ((as_int(inside) - 0x39800000) >> 14);
}

// The middle of the bin that contains the percentile of a colour, in millionths; 0 if nothing was
// counted. After the bins of all colours follow the sums of each RUN of them.
INLINE float white_patch_level(__global const uint *histogram, uint colour, uint millionths) {
    __global const uint *bins = histogram + colour * WHITE_PATCH_BINS;
    __global const uint *runs = histogram + (3 * RUN + colour) * (WHITE_PATCH_BINS / RUN);
    ulong count = 0, below = 0;
    for (uint k = 0; k < WHITE_PATCH_BINS / RUN; ++k) count += runs[k];
    if (count == 0) return 0.0f;
    const ulong rank = (count * millionths + 999999) / 1000000;
    uint run = 0;
    for (; below + runs[run] < rank; ++run) below += runs[run];
    uint bin = run * RUN;
    while ((below += bins[bin]) < rank) ++bin;
    return as_float(0x39800000 + (int)(bin << 14) + (1 << 13));
}

INLINE void white_patch(__global const uint *histogram, uint millionths,
                        __global const float *lights, int light_count, float light_tolerance,
                        extent e, __global float *estimates) {
    const float red = white_patch_level(histogram, 0, millionths);
    const float green = white_patch_level(histogram, 1, millionths);
    const float blue = white_patch_level(histogram, 2, millionths);
    estimates[0] = red > 0.0f && green > 0.0f ? green / red : 1.0f;
    estimates[1] = blue > 0.0f && green > 0.0f ? green / blue : 1.0f;
    limit_to_lights(estimates, lights, light_count, light_tolerance);
}
