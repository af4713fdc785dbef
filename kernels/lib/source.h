// Lanes from an image, or a tile of it, in the layout of files: interleaved channels or planes,
// half or float, no padding between rows. The buffer has space for whole blocks after its last
// pixel, so a block at the right or lower edge may read outside the image. Those values are never
// stored.
#ifndef CLPIPE_SOURCE_H
#define CLPIPE_SOURCE_H

#if LANES == 8
#define DEINTERLEAVE(a, b, c)                                            \
    {(vf)(a.s0, a.s3, a.s6, b.s1, b.s4, b.s7, c.s2, c.s5),               \
     (vf)(a.s1, a.s4, a.s7, b.s2, b.s5, c.s0, c.s3, c.s6),               \
     (vf)(a.s2, a.s5, b.s0, b.s3, b.s6, c.s1, c.s4, c.s7)}
#elif LANES == 16
#define DEINTERLEAVE(a, b, c)                                            \
    {(vf)(a.s0, a.s3, a.s6, a.s9, a.sc, a.sf, b.s2, b.s5,                \
          b.s8, b.sb, b.se, c.s1, c.s4, c.s7, c.sa, c.sd),               \
     (vf)(a.s1, a.s4, a.s7, a.sa, a.sd, b.s0, b.s3, b.s6,                \
          b.s9, b.sc, b.sf, c.s2, c.s5, c.s8, c.sb, c.se),               \
     (vf)(a.s2, a.s5, a.s8, a.sb, a.se, b.s1, b.s4, b.s7,                \
          b.sa, b.sd, c.s0, c.s3, c.s6, c.s9, c.sc, c.sf)}
#else
#define DEINTERLEAVE(a, b, c) {a, b, c}
#endif

INLINE rgb source_rgb_half(__global const half *src, site at, extent e) {
    __global const half *p = src + 3 * pixel_number(at, e);
    const vf a = load_half(p), b = load_half(p + LANES), c = load_half(p + 2 * LANES);
    const rgb v = DEINTERLEAVE(a, b, c);
    return v;
}

INLINE rgb source_rgb_float(__global const float *src, site at, extent e) {
    __global const float *p = src + 3 * pixel_number(at, e);
    const vf a = load(p), b = load(p + LANES), c = load(p + 2 * LANES);
    const rgb v = DEINTERLEAVE(a, b, c);
    return v;
}

// The same from consecutive planes.
INLINE rgb source_rgb_half_planes(__global const half *src, site at, extent e) {
    __global const half *p = src + pixel_number(at, e);
    const size_t plane = (size_t)e.columns * e.rows;
    const rgb v = {load_half(p), load_half(p + plane), load_half(p + 2 * plane)};
    return v;
}

INLINE rgb source_rgb_float_planes(__global const float *src, site at, extent e) {
    __global const float *p = src + pixel_number(at, e);
    const size_t plane = (size_t)e.columns * e.rows;
    const rgb v = {load(p), load(p + plane), load(p + 2 * plane)};
    return v;
}

INLINE vf source_mosaic_half(__global const half *src, site at, extent e) {
    return load_half(src + pixel_number(at, e));
}

INLINE vf source_mosaic_float(__global const float *src, site at, extent e) {
    return load(src + pixel_number(at, e));
}

#endif
