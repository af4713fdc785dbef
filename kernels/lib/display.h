// Eight-bit interleaved pixels, as an image file wants them.
#ifndef CLPIPE_DISPLAY_H
#define CLPIPE_DISPLAY_H

INLINE void store_rgb8(__global uchar *dst, const int *r, const int *g, const int *b, site at,
                       extent e) {
    if (at.y >= e.height) return;
    __global uchar *p = dst + 3 * ((size_t)at.y * e.width + at.x);
    if (at.x + LANES <= e.width) {
#pragma unroll
        for (int k = 0; k < LANES; ++k) {
            p[3 * k] = (uchar)r[k];
            p[3 * k + 1] = (uchar)g[k];
            p[3 * k + 2] = (uchar)b[k];
        }
    } else {
        for (uint k = 0; at.x + k < e.width; ++k) {
            p[3 * k] = (uchar)r[k];
            p[3 * k + 1] = (uchar)g[k];
            p[3 * k + 2] = (uchar)b[k];
        }
    }
}

// 0..1 to 0..255, rounded to nearest.
INLINE vi to_8_bit(vf v) {
    const vf inside = least(most(v, (vf)(0.0f)), (vf)(1.0f));
    return to_int(nearest(inside * 255.0f));
}

INLINE void encode_rgb(rgb c, __global uchar *dst, site at, extent e) {
    int r[LANES], g[LANES], b[LANES];
    spill_int(to_8_bit(c.r), r);
    spill_int(to_8_bit(c.g), g);
    spill_int(to_8_bit(c.b), b);
    store_rgb8(dst, r, g, b, at, e);
}

// A curve and the conversion to eight bits in one look-up.
INLINE void encode_rgb_by_table(rgb c, __global const uchar *table, __global uchar *dst, site at,
                                extent e) {
    int r[LANES], g[LANES], b[LANES];
    spill_int(curve_index(c.r), r);
    spill_int(curve_index(c.g), g);
    spill_int(curve_index(c.b), b);
#pragma unroll
    for (int k = 0; k < LANES; ++k) {
        r[k] = table[(uint)r[k]];
        g[k] = table[(uint)g[k]];
        b[k] = table[(uint)b[k]];
    }
    store_rgb8(dst, r, g, b, at, e);
}

INLINE void encode_mosaic(vf v, __global uchar *dst, site at, extent e) {
    int value[LANES];
    spill_int(to_8_bit(v), value);
    if (at.y >= e.height) return;
    __global uchar *p = dst + (size_t)at.y * e.width + at.x;
    for (uint k = 0; k < LANES && at.x + k < e.width; ++k) p[k] = (uchar)value[k];
}

#endif
