// A picture style: an S-curve on the contraharmonic mean of the three colours, the sum of their
// squares over their sum. All colours are scaled by one factor.
#include "lib/hue.h"

// The curve is x (a x + b) / (x (c x + d) + 1). With x as a fraction, one division is enough.
INLINE rgb standard(rgb v, site at, float a, float b, float c, float d, float saturation) {
#pragma OPENCL FP_CONTRACT ON
    const rgb x = {clipped_to_1(v.r), clipped_to_1(v.g), clipped_to_1(v.b)};
    const vf sum = x.r + x.g + x.b, squares = x.r * x.r + x.g * x.g + x.b * x.b;
    const vf below = squares * (c * squares + d * sum) + sum * sum;
    const vf share = (a * squares + b * sum) / vmax(below, (vf)(1e-24f));
    const vf factor = saturation * (share * sum), grey = (1.0f - saturation) * (share * squares);
    const rgb w = {x.r * factor + grey, x.g * factor + grey, x.b * factor + grey};
    return w;
}
