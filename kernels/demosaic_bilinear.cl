// Bilinear demosaicing: a missing colour is the mean of its nearest samples.
INLINE rgb bilinear(site at, src_image src, cfa pattern) {
    const vf centre = src_tap(src, 0, 0);
    const vf in_row = (src_tap(src, -1, 0) + src_tap(src, 1, 0)) * 0.5f;
    const vf in_column = (src_tap(src, 0, -1) + src_tap(src, 0, 1)) * 0.5f;
    const vf cross = (in_row + in_column) * 0.5f;
    const vf across = ((src_tap(src, -1, -1) + src_tap(src, 1, -1)) +
                       (src_tap(src, -1, 1) + src_tap(src, 1, 1))) * 0.25f;
    const pair colours = red_and_blue(at, pattern, centre, in_row, in_column, across);
    const rgb v = {colours.first, by_site(at, pattern, cross, centre, cross), colours.second};
    return v;
}
