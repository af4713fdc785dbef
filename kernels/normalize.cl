// DN back to signal: 0 at the black level, 1 at the white level; values below black stay negative.
INLINE vf normalize_levels(vf dn, site at, float black_level, float scale) {
    return (dn - black_level) * scale;
}
