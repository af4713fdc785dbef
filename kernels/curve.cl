// A curve on each channel, from a table that the host makes (tone curve, gamma).
INLINE rgb curve(rgb c, site at, __global const float *table) { return look_up(c, table); }
