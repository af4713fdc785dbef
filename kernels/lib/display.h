// Interleaved pixels of eight bits, the layout of image files.
#ifndef CLPIPE_DISPLAY_H
#define CLPIPE_DISPLAY_H

// 0..1 to 0..255, rounded to nearest.
INLINE vi to_8_bit(vf v) {
    const vf inside = vmin(vmax(v, (vf)(0.0f)), (vf)(1.0f));
    return to_int(nearest(inside * 255.0f));
}

// Three channels of levels, or of indices into a table of levels.
typedef struct { int r[LANES], g[LANES], b[LANES]; } levels;

INLINE levels levels_of(rgb c) {
    levels v;
    spill_int(to_8_bit(c.r), v.r);
    spill_int(to_8_bit(c.g), v.g);
    spill_int(to_8_bit(c.b), v.b);
    return v;
}

INLINE levels indices_of(rgb c) {
    levels v;
    spill_int(curve_index(c.r), v.r);
    spill_int(curve_index(c.g), v.g);
    spill_int(curve_index(c.b), v.b);
    return v;
}

INLINE uchar level(int number, __global const uchar *table, bool by_table) {
    return by_table ? table[(uint)number] : (uchar)number;
}

// Levels, or indices into a table. They come from memory, and all rows of a block are computed
// before the first is stored: a long chain of dependent operations on vectors and the many scalar
// operations of the row before would not fit into a CPU's window together.
INLINE void store_levels(const levels *v, __global const uchar *table, bool by_table,
                         __global uchar *dst, site at, extent e) {
    const uint x = at.x - e.left;
    if (at.y - e.top >= e.rows) return;
    __global uchar *p = dst + 3 * pixel_number(at, e);
#if LANES > 1
    if (x + LANES <= e.columns) {
        // Two numbers at once. Volatile, because the compiler would otherwise extract each number
        // from a vector, which is slower.
        const volatile ulong *r = (const volatile ulong *)v->r, *g = (const volatile ulong *)v->g;
        const volatile ulong *b = (const volatile ulong *)v->b;
#pragma unroll
        for (int k = 0; k < LANES; k += 2, p += 6) {
            const ulong two_r = r[k / 2], two_g = g[k / 2], two_b = b[k / 2];
            p[0] = level((int)two_r, table, by_table);
            p[1] = level((int)two_g, table, by_table);
            p[2] = level((int)two_b, table, by_table);
            p[3] = level((int)(two_r >> 32), table, by_table);
            p[4] = level((int)(two_g >> 32), table, by_table);
            p[5] = level((int)(two_b >> 32), table, by_table);
        }
        return;
    }
#endif
#pragma unroll 1
    for (int k = 0; k < LANES && x + k < e.columns; ++k) {
        p[3 * k] = level(v->r[k], table, by_table);
        p[3 * k + 1] = level(v->g[k], table, by_table);
        p[3 * k + 2] = level(v->b[k], table, by_table);
    }
}

INLINE void encode_mosaic(vf v, __global uchar *dst, site at, extent e) {
    int value[LANES];
    spill_int(to_8_bit(v), value);
    if (at.y - e.top >= e.rows) return;
    __global uchar *p = dst + pixel_number(at, e);
    for (uint k = 0; k < LANES && at.x - e.left + k < e.columns; ++k) p[k] = (uchar)value[k];
}

#endif
