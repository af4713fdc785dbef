// The well of a pixel holds no more than so much.
INLINE vf full_well(vf y, site at, float full_signal) { return vmin(y, (vf)(full_signal)); }
