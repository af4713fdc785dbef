// Standard normals that are correlated between red, green and blue, like in
// reference/correlated.py.
#ifndef CLPIPE_CORRELATED_H
#define CLPIPE_CORRELATED_H

// L n, with n three independent normals and L the lower triangle. L L' is the correlation of red,
// green and blue (Cholesky), and the first entry of L is 1.
INLINE rgb correlated_normals(site at, stream s, float green_red, float green_green, float blue_red,
                              float blue_green, float blue_blue) {
    const vf n0 = normal_at(at, 0, s), n1 = normal_at(at, 1, s), n2 = normal_at(at, 2, s);
    const rgb v = {n0, n0 * green_red + n1 * green_green,
                   n0 * blue_red + n1 * blue_green + n2 * blue_blue};
    return v;
}

#endif
