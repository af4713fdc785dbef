// The full well limits the signal of a pixel.
INLINE vf full_well(vf y, site at, float full_signal) { return vmin(y, (vf)(full_signal)); }
