// Dark-signal non-uniformity: each pixel has an offset of its own.
INLINE vf dsnu(vf y, site at, stream s, float sigma) { return y + normal_at(at, 0, s) * sigma; }
