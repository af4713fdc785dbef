// Independent Gaussian noise of one sigma for each channel.
INLINE rgb picture_noise(rgb c, site at, stream s, float red, float green, float blue) {
    const rgb v = {c.r + normal_at(at, 0, s) * red, c.g + normal_at(at, 1, s) * green,
                   c.b + normal_at(at, 2, s) * blue};
    return v;
}
