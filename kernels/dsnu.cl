// Dark-signal non-uniformity: a fixed offset for each pixel.
INLINE vf dsnu(vf y, site at, stream s, float sigma) { return y + normal_at(at, 0, s) * sigma; }
