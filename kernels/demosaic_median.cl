// Freeman's demosaicing (US patent 4,724,395, 1988): bilinear, then the colour differences are
// median filtered, the samples that the sensor took are kept, and the other colours follow.
#include "demosaic_bilinear.cl"

INLINE pair bilinear_differences(site at, src_image src, cfa pattern) {
    const rgb c = bilinear(at, src, pattern);
    const pair v = {c.r - c.g, c.b - c.g};
    return v;
}

INLINE rgb freeman(site at, src_image src, image spread, cfa pattern, int size) {
    const pair differences = {median_around(spread.plane0, spread, size),
                              median_around(spread.plane1, spread, size)};
    return from_differences(at, pattern, src_tap(src, 0, 0), differences);
}
