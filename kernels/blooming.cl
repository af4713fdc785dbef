// Charge above the full well flows along the column. Only * and +, so that NumPy gives the same
// bits.
INLINE vf excess_at(image src, int row, float full) {
    return vmax(tap_mosaic(src, 0, row) - full, (vf)(0.0f));
}

INLINE vf blooming(site at, image src, float full, float first, float spill) {
    vf received = (vf)(0.0f);
    float weight = first;
#pragma unroll
    for (int k = 1; k <= 16; ++k) {
        received = received + (excess_at(src, -k, full) + excess_at(src, k, full)) * weight;
        weight = weight * spill;
    }
    return vmin(vmin(tap_mosaic(src, 0, 0), (vf)(full)) + received, (vf)(full));
}
