// One gain for each colour of a mosaic (green = 1), for white balance and its inverse.
INLINE vf inverse_white_balance(vf y, site at, cfa pattern, float red, float blue) {
    return y * by_site(at, pattern, (vf)(red), (vf)(1.0f), (vf)(blue));
}

// Results above white are clipped: all three colours of a clipped highlight then have the same
// value, so it is white and not tinted.
INLINE vf white_balance(vf y, site at, cfa pattern, float red, float blue) {
    return vmin(y * by_site(at, pattern, (vf)(red), (vf)(1.0f), (vf)(blue)), (vf)(1.0f));
}
