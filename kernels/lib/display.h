// Interleaved pixels of eight bits, as image files have them.
#ifndef CLPIPE_DISPLAY_H
#define CLPIPE_DISPLAY_H

// 0..1 to 0..255, rounded to nearest.
INLINE vi to_8_bit(vf v) {
    const vf inside = vmin(vmax(v, (vf)(0.0f)), (vf)(1.0f));
    return to_int(nearest(inside * 255.0f));
}

// Stores three channels of levels, or of indices into a table of levels if there is one.
typedef struct {
    int r[LANES], g[LANES], b[LANES];
    __global const uchar *table;
} levels;

INLINE uint level(const levels *v, const int *channel, int k) {
    return v->table ? v->table[(uint)channel[k]] : (uint)channel[k];
}

INLINE void store_levels(const levels *v, __global uchar *dst, site at, extent e) {
    const uint x = at.x - e.left;
    if (at.y - e.top >= e.rows) return;
    __global uchar *p = dst + 3 * pixel_number(at, e);
#if LANES > 1
    if (x + LANES <= e.columns) {
        // Whole words, because a store for each byte would take most of the time.
        typedef uint unaligned_uint __attribute__((aligned(1)));
        __global unaligned_uint *word = (__global unaligned_uint *)p;
#pragma unroll
        for (int k = 0; k < LANES; k += 4, word += 3) {
            word[0] = level(v, v->r, k) | level(v, v->g, k) << 8 | level(v, v->b, k) << 16 |
                      level(v, v->r, k + 1) << 24;
            word[1] = level(v, v->g, k + 1) | level(v, v->b, k + 1) << 8 |
                      level(v, v->r, k + 2) << 16 | level(v, v->g, k + 2) << 24;
            word[2] = level(v, v->b, k + 2) | level(v, v->r, k + 3) << 8 |
                      level(v, v->g, k + 3) << 16 | level(v, v->b, k + 3) << 24;
        }
        return;
    }
#endif
    for (int k = 0; k < LANES && x + k < e.columns; ++k) {
        p[3 * k] = (uchar)level(v, v->r, k);
        p[3 * k + 1] = (uchar)level(v, v->g, k);
        p[3 * k + 2] = (uchar)level(v, v->b, k);
    }
}

INLINE void encode_rgb(rgb c, __global uchar *dst, site at, extent e) {
    levels v;
    v.table = 0;
    spill_int(to_8_bit(c.r), v.r);
    spill_int(to_8_bit(c.g), v.g);
    spill_int(to_8_bit(c.b), v.b);
    store_levels(&v, dst, at, e);
}

// A curve and the conversion to eight bits in one look-up.
INLINE void encode_rgb_by_table(rgb c, __global const uchar *table, __global uchar *dst, site at,
                                extent e) {
    levels v;
    v.table = table;
    spill_int(curve_index(c.r), v.r);
    spill_int(curve_index(c.g), v.g);
    spill_int(curve_index(c.b), v.b);
    store_levels(&v, dst, at, e);
}

INLINE void encode_mosaic(vf v, __global uchar *dst, site at, extent e) {
    int value[LANES];
    spill_int(to_8_bit(v), value);
    if (at.y - e.top >= e.rows) return;
    __global uchar *p = dst + pixel_number(at, e);
    for (uint k = 0; k < LANES && at.x - e.left + k < e.columns; ++k) p[k] = (uchar)value[k];
}

#endif
