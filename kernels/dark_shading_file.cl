// A measured map with linear interpolation between its samples. Only * and +, so that NumPy gives
// the same bits.
INLINE vf sample_of(__global const float *map, vi row, vi column, int width) {
#if LANES == 1
    return map[row * width + column];
#else
    int index[LANES];
    float value[LANES];
    spill_int(row * (vi)(width) + column, index);
    for (int k = 0; k < LANES; ++k) value[k] = map[index[k]];
    return unspill(value);
#endif
}

// A position on an axis of `count` samples, from its pixel: the sample before it, and the share of
// the next one.
typedef struct {
    vi first, second;
    vf share;
} between;

INLINE between between_samples(vf pixel, float per_px, int count) {
    const vf last = (vf)((float)(count - 1));
    const vf t = vmin(vmax((pixel + 0.5f) * per_px - 0.5f, (vf)(0.0f)), last);
    const vi first = to_int(t);
    const between b = {first, vmin_int(first + 1, (vi)(count - 1)), t - to_float(first)};
    return b;
}

INLINE vf dark_shading_file(vf y, site at, __global const float *map, int width, int height, float per_px) {
    const between x = between_samples(to_float(iota() + (vi)((int)at.x)), per_px, width);
    const between v = between_samples((vf)((float)at.y), per_px, height);
    const vf above = sample_of(map, v.first, x.first, width), below = sample_of(map, v.second, x.first, width);
    const vf above_right = sample_of(map, v.first, x.second, width);
    const vf below_right = sample_of(map, v.second, x.second, width);
    const vf upper = above + (above_right - above) * x.share;
    const vf lower = below + (below_right - below) * x.share;
    return y + (upper + (lower - upper) * v.share);
}
