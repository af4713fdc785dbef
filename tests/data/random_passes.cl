// Functions of the stages that tests/test_random_plans.py puts together at random.
INLINE rgb doubled(rgb c, site at) {
    const rgb v = {c.r * 2.0f, c.g * 2.0f, c.b * 2.0f};
    return v;
}

INLINE rgb halved(rgb c, site at) {
    const rgb v = {c.r * 0.5f, c.g * 0.5f, c.b * 0.5f};
    return v;
}

INLINE rgb raised(rgb c, site at, float by) {
    const rgb v = {c.r + by, c.g - by, c.b + by * 0.5f};
    return v;
}

INLINE vf added_up(rgb c, site at) { return (c.r + c.g) + c.b; }

INLINE rgb spread_out(vf y, site at) {
    const rgb v = {y, y * 0.5f, y * 0.25f};
    return v;
}

INLINE vf slope(site at, image one, int reach) {
    return tap_mosaic(one, reach, reach) - tap_mosaic(one, -reach, 0) * 0.5f;
}

INLINE vf offsets(vu line, float by) { return to_float(signed_bits(line) & 3) * by; }

INLINE rgb with_offsets(rgb c, site at, __global const float *lines) {
    const float own = lines[at.y];
    const rgb v = {c.r + own, c.g + own, c.b - own};
    return v;
}

INLINE vi is_bright(rgb c, site at) { return c.g > (vf)(0.5f) ? (vi)(1) : (vi)(0); }

INLINE void gain_of(long4 sums, extent e, __global float *estimates) {
    const int bright = (int)(((sums.x + sums.y) + (sums.z + sums.w)) & 7);
    estimates[0] = 0.5f + (float)bright * 0.125f;
}

INLINE rgb scaled(rgb c, site at, float gain) {
    const rgb v = {c.r * gain, c.g * gain, c.b * gain};
    return v;
}
