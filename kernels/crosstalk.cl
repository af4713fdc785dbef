// Charge that leaks to the four neighbours. Only * and +, so that NumPy gives the same bits.
INLINE vf crosstalk(site at, image src, float share) {
    const vf across = tap_mosaic(src, -1, 0) + tap_mosaic(src, 1, 0);
    const vf down = tap_mosaic(src, 0, -1) + tap_mosaic(src, 0, 1), own = tap_mosaic(src, 0, 0);
    return own + ((across + down) - own * 4.0f) * share;
}
