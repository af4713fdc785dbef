// Independent Gaussian noise whose sigma follows each channel's intensity, by a table of 256 entries
// for each channel (SyB3R; Ley, Haensch, Hellwich 2016).
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

INLINE rgb picture_noise(rgb c, site at, stream s, __global const float *sigmas) {
    const rgb v = {c.r + normal_at(at, 0, s) * sigma_at(c.r, sigmas),
                   c.g + normal_at(at, 1, s) * sigma_at(c.g, sigmas + 256),
                   c.b + normal_at(at, 2, s) * sigma_at(c.b, sigmas + 512)};
    return v;
}
