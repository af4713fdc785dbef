// Hot pixels have extra charge, and dead pixels have no signal. The upper 31 bits of a pixel's
// random word decide whether it is hot or dead. Divided by the limit for hot pixels, they also
// determine the extra charge.
INLINE vf defect_pixels(vf y, site at, stream s, int hot_limit, int dead_limit, float hot_scale, float hot_level) {
    const vi bits = signed_bits(word_at(at, 0, s) >> 1);
    const vf excess = negative_log((to_float(bits) + 0.5f) * hot_scale);
    const vf hot = y + hot_level * (1.0f + vmax(excess, (vf)(0.0f)));
    return bits > dead_limit ? (vf)(0.0f) : bits < hot_limit ? hot : y;
}
