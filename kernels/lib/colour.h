// ITU-R BT.601 luma and colour differences, on linear RGB, with the paper's rounded factors.
#ifndef CLPIPE_COLOUR_H
#define CLPIPE_COLOUR_H

INLINE ycbcr rgb_to_ycbcr(rgb c) {
    const vf y = 0.299f * c.r + 0.587f * c.g + 0.114f * c.b;
    const ycbcr v = {y, 0.564f * (c.b - y), 0.713f * (c.r - y)};
    return v;
}

// The exact inverse of the above: 1/0.713, 1/0.564, and green from the luma equation.
INLINE rgb ycbcr_to_rgb(ycbcr c) {
    const vf r = c.y + c.cr * 1.4025246f;
    const vf b = c.y + c.cb * 1.7730496f;
    const rgb v = {r, (c.y - 0.299f * r - 0.114f * b) * 1.7035775f, b};
    return v;
}

#endif
