// Raises red and blue of nearly white pixels, so that dividing by the gains leaves them white
// (Brooks et al. 2019).
INLINE rgb restore_highlights(rgb c, site at, float red_gain, float blue_gain) {
    const vf grey = ((c.r + c.g) + c.b) * 0.33333334f;
    const vf over = vmax(grey - 0.9f, (vf)(0.0f)) * 10.0f;
    const vf m = vmin(over * over, (vf)(1.0f));
    const vf red = vmax(m * red_gain + (1.0f - m), (vf)(1.0f));
    const vf blue = vmax(m * blue_gain + (1.0f - m), (vf)(1.0f));
    const rgb v = {c.r * red, c.g, c.b * blue};
    return v;
}
