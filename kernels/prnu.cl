// Photo-response non-uniformity: each pixel is a little more or less sensitive.
INLINE vf prnu(vf y, site at, stream s, float sigma) {
    return y * (normal_at(at, 0, s) * sigma + 1.0f);
}
