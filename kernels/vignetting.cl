// Light that decreases towards the corners, by the distance from the position x, y. Only * and +,
// so that NumPy gives the same bits.
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

INLINE rgb times(rgb c, vf gain) {
    const rgb v = {c.r * gain, c.g * gain, c.b * gain};
    return v;
}

// r is 1 at the corner pixel.
INLINE rgb vignetting_pa(rgb c, site at, extent e, float k1, float k2, float k3) {
    const float width = e.width > 1 ? (float)(e.width - 1) : 1.0f;
    const float height = e.height > 1 ? (float)(e.height - 1) : 1.0f;
    const vf corner = (vf)((width * width + height * height) * 0.25f);
    const vf r2 = squared_radius(at, 0.5f * (float)e.width, 0.5f * (float)e.height) * reciprocal(corner);
    return times(c, vmax(((r2 * k3 + k2) * r2 + k1) * r2 + 1.0f, (vf)(0.0f)));
}

// r is the tangent of the angle to the axis, so 1 / (1 + r^2) is its cosine squared. `per_px` is
// set for a focal length in px, and `per_side` for one in longer sides; the other one is 0.
INLINE rgb vignetting_cosine(rgb c, site at, extent e, float x, float y, float per_px, float per_side) {
    const float side = (float)(e.width > e.height ? e.width : e.height);
    const vf unit = per_px > 0.0f ? (vf)(per_px) : (vf)(per_side) * reciprocal((vf)(side * side));
    const vf cosine = reciprocal(squared_radius(at, x, y) * unit + 1.0f);
    return times(c, cosine * cosine);
}
