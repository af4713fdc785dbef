// Exposure compensation: linear light times 2^EV, which the host computes as one gain.
INLINE rgb exposure(rgb c, site at, float gain) {
    const rgb v = {c.r * gain, c.g * gain, c.b * gain};
    return v;
}
