// Photo-response non-uniformity: a fixed sensitivity for each pixel, with the mean 1.
INLINE vf prnu(vf y, site at, stream s, float sigma) {
    return y * (normal_at(at, 0, s) * sigma + 1.0f);
}
