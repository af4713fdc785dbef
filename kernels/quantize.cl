// The ADC: signal to whole DN, clipped to 0..white level.
INLINE vf quantize(vf y, site at, float range, float black_level, float white_level) {
    return vmin(vmax(nearest(y * range + black_level), (vf)(0.0f)), (vf)(white_level));
}
