// The full well: the signal of a pixel is limited.
INLINE vf full_well(vf y, site at, float full_signal) { return vmin(y, (vf)(full_signal)); }
