// A picture style on the largest and the smallest of the three colours; the one between keeps its place.
#include "lib/style.h"

INLINE rgb standard(rgb v, site at, float grey, float a, float b, float c, float d, float bright_a,
                    float bright_b, float bright_c, float bright_d) {
#pragma OPENCL FP_CONTRACT ON
    const style s = {grey, a, b, c, d, bright_a, bright_b, bright_c, bright_d};
    const extremes x = extremes_of(v);
    const fraction low = styled(x.low, s), high = styled(x.high, s);
    const vf largest = vmax(x.high, (vf)(1e-9f)), range = vmax(x.high - x.low, (vf)(1e-6f));
    // One division for four.
    const vf both = low.below * high.below, others = largest * range, inverse = 1.0f / (both * others);
    const vf per_low = inverse * others * high.below, per_high = inverse * others * low.below;
    const vf per_largest = inverse * both * range, per_range = inverse * both * largest;
    const vf to_high = high.above * per_high;
    const vf to_low = styled_low(low.above * per_low, x.low, to_high * per_largest);
    const vf slope = (to_high - to_low) * per_range;
    const rgb w = {to_low + (x.inside.r - x.low) * slope, to_low + (x.inside.g - x.low) * slope,
                   to_low + (x.inside.b - x.low) * slope};
    return w;
}
