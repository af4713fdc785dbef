// Median of a square window of luma and of chroma, blended with the centre.
#include "lib/luma_chroma.h"

INLINE vf mixed_with_median(__global const float *plane, image planes, int reach, float share) {
    const vf centre = tap_plane(plane, planes, 0, 0);
    return reach ? centre + share * (median_around(plane, planes, 2 * reach + 1) - centre) : centre;
}

INLINE ycbcr median_filter(site at, image planes, int luma_reach, int chroma_reach,
                           float luma_share, float chroma_share) {
    const ycbcr v = {mixed_with_median(planes.plane0, planes, luma_reach, luma_share),
                     mixed_with_median(planes.plane1, planes, chroma_reach, chroma_share),
                     mixed_with_median(planes.plane2, planes, chroma_reach, chroma_share)};
    return v;
}
