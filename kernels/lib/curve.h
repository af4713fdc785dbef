// One-dimensional curves as tables. The index is the upper part of the float itself, so entries are
// spaced evenly in ratio instead of difference. There are 20 octaves below 1 with CURVE_STEPS each,
// fine in the shadows where a gamma curve is steep. A value takes the nearest entry. Two curves can
// therefore be composed to one table that gives the same bits as two look-ups in sequence.
#ifndef CLPIPE_CURVE_H
#define CLPIPE_CURVE_H

INLINE vi curve_index(vf v) {
    const vf inside = vmin(vmax(v, (vf)(9.5367431640625e-07f)), (vf)(1.0f));
    return ((float_bits(inside) + 0x400) >> 11) - (0x35800000 >> 11);
}

#define GATHER(channel)                                                             \
    spill_int(curve_index(c.channel), index);                                       \
    for (int k = 0; k < LANES; ++k) value[k] = table[index[k]];                     \
    v.channel = *(__private unaligned_vf *)value;
INLINE rgb look_up(rgb c, __global const float *table) {
    rgb v;
#if LANES == 1
    v.r = table[curve_index(c.r)];
    v.g = table[curve_index(c.g)];
    v.b = table[curve_index(c.b)];
#else
    int index[LANES];
    float value[LANES];
    GATHER(r) GATHER(g) GATHER(b)
#endif
    return v;
}
#undef GATHER

#endif
