// Freeman's demosaicing (US patent 4,724,395, 1988): bilinear, then a median filter on the colour
// differences. The sensor's samples do not change, and the missing colours follow from the
// differences.
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
