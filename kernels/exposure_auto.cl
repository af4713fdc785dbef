#include "exposure.cl"
// Auto exposure: a gain that brings the luminance of the image to a target. Positions are weighted
// by a circle around the centre. `share` is the image's shorter side over its diameter, and with 0
// all positions are inside.
#define METER_STEPS 4096  // per unit of the logarithm to base 2
#define METER_BINS 9216   // 36 octaves from 2^-18 on, with 256 bins each

// Linear sRGB (ITU-R BT.709).
#define LUMINANCE(r, g, b) (0.2126f * (r) + 0.7152f * (g) + 0.0722f * (b))

// Positions are in half pixels from the centre.
INLINE float half_pixels(uint place, uint size) { return (float)(2 * (int)place + 1 - (int)size); }

// (diameter of the circle * share)^2.
INLINE float circle(uint share, extent e) {
    const uint shorter = e.width < e.height ? e.width : e.height;
    const float diameter = (float)(shorter > 2 * share ? shorter : 2 * share);
    return diameter * diameter;
}

INLINE bool in_circle(uint x, uint y, uint share, extent e) {
    const float dx = half_pixels(x, e.width), dy = half_pixels(y, e.height);
    return (dx * dx + dy * dy) * (float)(share * share) <= circle(share, e);
}

// log2 of a level above 0, in steps.
INLINE vi steps_of(vf level) { return to_int(nearest(negative_log(level) * -5909.2788875f)); }

INLINE int steps_of_one(float level) {
    int lanes[LANES];
    spill_int(steps_of((vf)(level)), lanes);
    return lanes[0];
}

// The last step of both rules: the stops from the measured level to the target, and the gain.
INLINE void meter(bool lit, int level, int target, int lowest, int highest, float offset,
                  __global float *estimates) {
    const int steps = target - level;
    const int inside = steps < lowest ? lowest : steps > highest ? highest : steps;
    const float ev = (float)(lit ? inside : 0) * (1.0f / METER_STEPS);
    vf e;
    const vf s = power_of_two((vf)(ev), &e);
    float lanes[LANES];
    spill(s + s * e, lanes);
    estimates[0] = ev;
    estimates[1] = lanes[0] * offset;
}

// Log-average luminance (Reinhard et al. 2002): each pixel's log2 in steps, times its weight.
INLINE vi metered_log(rgb c, site at, extent e, uint share, uint inside, uint outside,
                      float delta) {
    const vf dx = to_float(iota() * 2 + (vi)(2 * (int)at.x + 1 - (int)e.width));
    const float dy = half_pixels(at.y, e.height);
    const vi weight = (dx * dx + dy * dy) * (float)(share * share) <= (vf)(circle(share, e))
                          ? (vi)((int)inside)
                          : (vi)((int)outside);
    const vf light = vmax(LUMINANCE(c.r, c.g, c.b), (vf)(0.0f));
    return steps_of(light + delta) * weight;
}

// The number of pixels in the circle, row by row; the circle's edge moves outwards up to the
// middle.
INLINE ulong count_in_circle(uint share, extent e) {
    ulong count = 0;
    uint left = (e.width + 1) / 2;
    for (uint y = 0; y < (e.height + 1) / 2; ++y) {
        while (left > 0 && in_circle(left - 1, y, share, e)) --left;
        const uint across = e.width > 2 * left ? e.width - 2 * left : 0;
        count += (ulong)across * (2 * y + 1 == e.height ? 1 : 2);
    }
    return count;
}

INLINE void meter_log_average(long4 sums, uint share, uint inside, uint outside, float delta,
                              int target, int lowest, int highest, float offset, extent e,
                              __global float *estimates) {
    const long total = sums.x + sums.y + sums.z + sums.w;
    const long all = (long)e.width * (long)e.height, within = (long)count_in_circle(share, e);
    const long weight = within * (long)inside + (all - within) * (long)outside;
    const long twice = 2 * total + weight, by = 2 * weight;
    const long mean = twice / by - (twice % by < 0 ? 1 : 0);
    const bool lit = total != weight * (long)steps_of_one(delta);
    meter(lit, (int)mean, target, lowest, highest, offset, estimates);
}

// The bin of a pixel by the upper bits of its luminance; pixels outside the circle are counted
// separately.
INLINE int metered_bin(__global const float *red, __global const float *green,
                       __global const float *blue, uint x, uint y, extent e, uint share,
                       uint outside) {
    const bool is_inside = in_circle(x, y, share, e);
    if (!is_inside && outside == 0) return -1;
    const size_t i = (size_t)y * e.pitch + x;
    const float light = LUMINANCE(red[i], green[i], blue[i]);
    const int bin = (as_int(light > 0x1p-18f ? light : 0x1p-18f) - 0x36800000) >> 15;
    const int bounded = bin < METER_BINS ? bin : METER_BINS - 1;
    return is_inside ? bounded : METER_BINS + bounded;
}

// The middle of the bin that contains the percentile, in millionths of all weights. After the bins
// follow the sums of each RUN of them.
INLINE void meter_percentile(__global const uint *histogram, uint inside, uint outside,
                             uint millionths, int target, int lowest, int highest, float offset,
                             extent e, __global float *estimates) {
    __global const uint *others = histogram + METER_BINS;
    __global const uint *runs = histogram + 2 * METER_BINS, *other_runs = runs + METER_BINS / RUN;
    ulong count = 0, below = 0;
    for (uint k = 0; k < METER_BINS / RUN; ++k)
        count += (ulong)runs[k] * inside + (ulong)other_runs[k] * outside;
    const ulong rank = (count * millionths + 999999) / 1000000;
    uint run = 0;
    for (;; ++run) {
        const ulong in_run = (ulong)runs[run] * inside + (ulong)other_runs[run] * outside;
        if (below + in_run >= rank) break;
        below += in_run;
    }
    uint bin = run * RUN;
    while ((below += (ulong)histogram[bin] * inside + (ulong)others[bin] * outside) < rank) ++bin;
    const float middle = as_float(0x36800000 + (int)(bin << 15) + (1 << 14));
    meter(bin != 0, steps_of_one(middle), target, lowest, highest, offset, estimates);
}
