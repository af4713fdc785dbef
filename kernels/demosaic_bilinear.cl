// Bilinear demosaicing: a missing colour is the mean of its nearest samples.
INLINE rgb bilinear(site at, src_image src, cfa pattern) {
    const vf centre = src_tap(src, 0, 0);
    const vf horizontal = (src_tap(src, -1, 0) + src_tap(src, 1, 0)) * 0.5f;
    const vf vertical = (src_tap(src, 0, -1) + src_tap(src, 0, 1)) * 0.5f;
    const vf cross = (horizontal + vertical) * 0.5f;
    const vf diagonal = ((src_tap(src, -1, -1) + src_tap(src, 1, -1)) +
                         (src_tap(src, -1, 1) + src_tap(src, 1, 1))) * 0.25f;
    const vi red_column = in_red_column(at, pattern);
    rgb v;
    if (in_red_row(at, pattern)) {
        v.r = red_column ? centre : horizontal;
        v.g = red_column ? cross : centre;
        v.b = red_column ? diagonal : vertical;
    } else {
        v.r = red_column ? vertical : diagonal;
        v.g = red_column ? centre : cross;
        v.b = red_column ? horizontal : centre;
    }
    return v;
}
