// A rational curve with a toe and a shoulder.
#include "lib/hue.h"

INLINE vf filmic_of(vf x, float a, float b, float c, float d) {
#pragma OPENCL FP_CONTRACT ON
    return x * (a * x + b) / (x * (c * x + d) + 1.0f);
}

INLINE rgb filmic(rgb v, site at, float a, float b, float c, float d) {
    const extremes x = extremes_of(v);
    return between_extremes(x, filmic_of(x.low, a, b, c, d), filmic_of(x.high, a, b, c, d));
}
