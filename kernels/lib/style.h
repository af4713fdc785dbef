// A picture style: a rational curve from black to grey and another from grey to white, on the
// largest of the three colours; see clpipe/stages/tone_curve/standard.py.
#ifndef CLPIPE_STYLE_H
#define CLPIPE_STYLE_H

#include "lib/hue.h"

// The share of a colour's distance from the grey of its largest component that remains; `high` is
// that component.
INLINE vf colourfulness(vf high, float saturation) {
#pragma OPENCL FP_CONTRACT ON
    const vf square = high * high;
    return saturation - 0.5f * square * square;
}

#endif
