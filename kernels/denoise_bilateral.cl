// Bilateral filter (Tomasi and Manduchi 1998) on luma and chroma, each with its own range sigma.
// Scales come in as -log2(e) / (2 sigma^2), so that a weight is one power of two.
INLINE ycbcr to_luma_chroma(rgb c, site at) { return rgb_to_ycbcr(c); }

INLINE ycbcr bilateral(site at, image src_planes, int radius, float spatial_scale,
                       float luma_scale, float chroma_scale) {
    const ycbcr centre = tap_ycbcr(src_planes, 0, 0);
    ycbcr sum = centre;
    vf luma_weight = (vf)(1.0f), chroma_weight = (vf)(1.0f);
#pragma unroll
    for (int dy = -radius; dy <= radius; ++dy) {
#pragma unroll
        for (int dx = -radius; dx <= radius; ++dx) {
            if (dx == 0 && dy == 0) continue;
            const ycbcr c = tap_ycbcr(src_planes, dx, dy);
            const vf near = (vf)((float)(dx * dx + dy * dy) * spatial_scale);
            const vf d = c.y - centre.y, db = c.cb - centre.cb, dr = c.cr - centre.cr;
            const vf chroma_distance = fma(db, db, dr * dr);
            const vf wy = exp2_of_negative(fma(d * d, (vf)(luma_scale), near));
            const vf wc = exp2_of_negative(fma(chroma_distance, (vf)(chroma_scale), near));
            sum.y = fma(wy, c.y, sum.y);
            sum.cb = fma(wc, c.cb, sum.cb);
            sum.cr = fma(wc, c.cr, sum.cr);
            luma_weight += wy;
            chroma_weight += wc;
        }
    }
    const ycbcr v = {sum.y / luma_weight, sum.cb / chroma_weight, sum.cr / chroma_weight};
    return v;
}

INLINE rgb from_luma_chroma(ycbcr c, site at) { return ycbcr_to_rgb(c); }
