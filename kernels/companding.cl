// Companding by a piecewise linear curve: DN to fewer DN, and back. For each piece, `pieces`
// contains its start, the value there, and its slope.
INLINE vf along_pieces(vf x, __global const float *pieces, int count) {
    vf v = pieces[1] + (x - pieces[0]) * pieces[2];
    for (int i = 1; i < count; ++i) {
        __global const float *piece = pieces + 3 * i;
        const vf extended = piece[1] + (x - piece[0]) * piece[2];
        v = x >= piece[0] ? extended : v;
    }
    return v;
}

// After the ADC, whose DN are integers.
INLINE vf compand(vf y, site at, float range, float black_level, float white_level, __global const float *pieces, int count) {
    const vf dn = vmin(vmax(nearest(y * range + black_level), (vf)(0.0f)), (vf)(white_level));
    return nearest(along_pieces(dn, pieces, count));
}

// Before the levels.
INLINE vf expand(vf dn, site at, float black_level, float scale, __global const float *pieces, int count) {
    return (along_pieces(dn, pieces, count) - black_level) * scale;
}
