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

#if LANES == 1
typedef int stored_int;
#else
// Volatile, because the compiler would otherwise extract each number from a vector, which is
// slower.
typedef volatile int stored_int;
#endif
INLINE uchar level(const stored_int *number, __global const uchar *table, bool by_table) {
    return by_table ? table[(uint)*number] : (uchar)*number;
}

#define R(k) level(v->r + (k), table, by_table)
#define G(k) level(v->g + (k), table, by_table)
#define B(k) level(v->b + (k), table, by_table)
INLINE void store_levels(const levels *v, __global const uchar *table, bool by_table,
                         __global uchar *dst, site at, extent e) {
    const uint x = at.x - e.left;
    if (at.y - e.top >= e.rows) return;
    __global uchar *p = dst + 3 * pixel_number(at, e);
#if LANES > 1
    if (x + LANES <= e.columns) {
        // Eight bytes at once, because separate stores would take most of the time.
        typedef uchar8 unaligned_uchar8 __attribute__((aligned(1)));
        __global unaligned_uchar8 *bytes = (__global unaligned_uchar8 *)p;
#pragma unroll
        for (int k = 0; k < LANES; k += 8, bytes += 3) {
            bytes[0] = (uchar8)(R(k), G(k), B(k), R(k + 1), G(k + 1), B(k + 1), R(k + 2), G(k + 2));
            bytes[1] = (uchar8)(B(k + 2), R(k + 3), G(k + 3), B(k + 3), R(k + 4), G(k + 4), B(k + 4),
                                R(k + 5));
            bytes[2] = (uchar8)(G(k + 5), B(k + 5), R(k + 6), G(k + 6), B(k + 6), R(k + 7), G(k + 7),
                                B(k + 7));
        }
        return;
    }
#endif
#pragma unroll 1
    for (int k = 0; k < LANES && x + k < e.columns; ++k) {
        p[3 * k] = R(k);
        p[3 * k + 1] = G(k);
        p[3 * k + 2] = B(k);
    }
}
#undef R
#undef G
#undef B

INLINE void encode_rgb(rgb c, __global uchar *dst, site at, extent e) {
    levels v;
    spill_int(to_8_bit(c.r), v.r);
    spill_int(to_8_bit(c.g), v.g);
    spill_int(to_8_bit(c.b), v.b);
    store_levels(&v, 0, false, dst, at, e);
}

// A curve and the conversion to eight bits in one look-up.
INLINE void encode_rgb_by_table(rgb c, __global const uchar *table, __global uchar *dst, site at,
                                extent e) {
    levels v;
    spill_int(curve_index(c.r), v.r);
    spill_int(curve_index(c.g), v.g);
    spill_int(curve_index(c.b), v.b);
    store_levels(&v, table, true, dst, at, e);
}

INLINE void encode_mosaic(vf v, __global uchar *dst, site at, extent e) {
    int value[LANES];
    spill_int(to_8_bit(v), value);
    if (at.y - e.top >= e.rows) return;
    __global uchar *p = dst + pixel_number(at, e);
    for (uint k = 0; k < LANES && at.x - e.left + k < e.columns; ++k) p[k] = (uchar)value[k];
}

#endif
