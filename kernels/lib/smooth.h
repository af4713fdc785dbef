// Binomial means of 3x3 pixels, whose differences hardly contain a pixel's noise.
#ifndef CLPIPE_SMOOTH_H
#define CLPIPE_SMOOTH_H

INLINE vf binomial(vf a, vf b, vf c) { return a + c + 2.0f * b; }

INLINE ycbcr smooth(site at, image planes) {
#pragma OPENCL FP_CONTRACT ON
    ycbcr rows[3];
#pragma unroll
    for (int y = 0; y < 3; ++y) {
        const ycbcr a = tap_ycbcr(planes, -1, y - 1), b = tap_ycbcr(planes, 0, y - 1);
        const ycbcr c = tap_ycbcr(planes, 1, y - 1);
        rows[y].y = binomial(a.y, b.y, c.y);
        rows[y].cb = binomial(a.cb, b.cb, c.cb);
        rows[y].cr = binomial(a.cr, b.cr, c.cr);
    }
    const ycbcr v = {binomial(rows[0].y, rows[1].y, rows[2].y) * 0.0625f,
                     binomial(rows[0].cb, rows[1].cb, rows[2].cb) * 0.0625f,
                     binomial(rows[0].cr, rows[1].cr, rows[2].cr) * 0.0625f};
    return v;
}

#endif
