// Distances from a position of the image. Only * and +, so that NumPy gives the same bits.
#ifndef CLPIPE_RADIUS_H
#define CLPIPE_RADIUS_H

INLINE vf squared_radius(site at, float x, float y) {
    const vf dx = to_float(iota() + (vi)((int)at.x)) + 0.5f - x;
    const float dy = (float)at.y + 0.5f - y;
    return dx * dx + dy * dy;
}

// 1 / x for x > 0.
INLINE vf reciprocal(vf x) {
    const vf root = inverse_root(x);
    return root * root;
}

// The squared distance from the centre; 1 at the corner pixel.
INLINE vf relative_radius(site at, extent e) {
    const float width = e.width > 1 ? (float)(e.width - 1) : 1.0f;
    const float height = e.height > 1 ? (float)(e.height - 1) : 1.0f;
    const vf corner = (vf)((width * width + height * height) * 0.25f);
    return squared_radius(at, 0.5f * (float)e.width, 0.5f * (float)e.height) * reciprocal(corner);
}

#endif
