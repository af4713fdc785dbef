// A rational curve, x (a x + b) / (x (c x + d) + 1), on the largest and the smallest of the three
// colours. The middle one keeps its relative position, which is its hue (like in Adobe's DNG
// software).
#include "lib/hue.h"

// The slope of the chord between both ends has the product of their denominators as its
// denominator, and the difference of the ends cancels. One division is enough for all. `twist` is a
// d - b c.
INLINE rgb neutral(rgb v, site at, float a, float b, float c, float d, float twist) {
#pragma OPENCL FP_CONTRACT ON
    const extremes x = extremes_of(v);
    const vf below_low = x.low * (c * x.low + d) + 1.0f;
    const vf below_high = x.high * (c * x.high + d) + 1.0f;
    const vf scale = 1.0f / (below_low * below_high);
    const vf low = x.low * (a * x.low + b) * below_high * scale;
    const vf slope = (a * (x.high + x.low) + b + twist * (x.high * x.low)) * scale;
    const rgb w = {low + (x.inside.r - x.low) * slope, low + (x.inside.g - x.low) * slope,
                   low + (x.inside.b - x.low) * slope};
    return w;
}
