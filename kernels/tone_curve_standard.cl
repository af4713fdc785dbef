// A picture style: the largest of the three colours takes the curve's value, and all colours keep
// their ratios.
#include "lib/style.h"

// The pieces of the curve are v (a v + b) / (v (c v + d) + 1); for the bright piece, v is the
// distance from white.
INLINE rgb standard(rgb v, site at, float grey, float a, float b, float c, float d, float bright_a,
                    float bright_b, float bright_c, float bright_d, float saturation) {
#pragma OPENCL FP_CONTRACT ON
    const extremes x = extremes_of(v);
    const vi dark = x.high < grey;
    const vf u = dark ? x.high : 1.0f - x.high;
    const vf square = dark ? (vf)(a) : (vf)(bright_a), slope = dark ? (vf)(b) : (vf)(bright_b);
    const vf below_square = dark ? (vf)(c) : (vf)(bright_c), below_slope = dark ? (vf)(d) : (vf)(bright_d);
    const vf above = u * (square * u + slope), below = u * (below_square * u + below_slope) + 1.0f;
    const vf scaled = vmax(x.high, (vf)(1e-9f)), inverse = 1.0f / (below * scaled);
    const vf ratio = (dark ? above : below - above) * inverse, high = ratio * scaled;
    const vf kept = colourfulness(x.high, saturation), grey_part = high - kept * high;
    const vf part = kept * ratio;
    const rgb w = {x.inside.r * part + grey_part, x.inside.g * part + grey_part,
                   x.inside.b * part + grey_part};
    return w;
}
