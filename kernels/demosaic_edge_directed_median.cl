// Edge-directed demosaicing with Freeman's median step, in three passes.

// Green along the edge, not across it (Hamilton and Adams 1997): the direction with the smaller
// gradient; equal gradients take the mean of both. The result is held in one plane: green at green
// sites, the colour difference (R-G or B-G) at red and blue ones.
INLINE vf green_or_difference(site at, src_image src, cfa pattern) {
    const vf centre = src_tap(src, 0, 0);
    const vf west = src_tap(src, -1, 0), east = src_tap(src, 1, 0);
    const vf north = src_tap(src, 0, -1), south = src_tap(src, 0, 1);
    const vf bend_x = 2.0f * centre - src_tap(src, -2, 0) - src_tap(src, 2, 0);
    const vf bend_y = 2.0f * centre - src_tap(src, 0, -2) - src_tap(src, 0, 2);
    const vf gradient_x = magnitude(west - east) + magnitude(bend_x);
    const vf gradient_y = magnitude(north - south) + magnitude(bend_y);
    const vf green_x = (west + east) * 0.5f + bend_x * 0.25f;
    const vf green_y = (north + south) * 0.5f + bend_y * 0.25f;
    const vf either = (green_x + green_y) * 0.5f;
    const vf green = gradient_x < gradient_y ? green_x : gradient_y < gradient_x ? green_y : either;
    return by_site(at, pattern, centre - green, centre, centre - green);
}

// Colour differences at every pixel, bilinear from where they are known.
INLINE differences spread_differences(site at, image known, cfa pattern) {
    const vf centre = tap_mosaic(known, 0, 0);
    const vf horizontal = (tap_mosaic(known, -1, 0) + tap_mosaic(known, 1, 0)) * 0.5f;
    const vf vertical = (tap_mosaic(known, 0, -1) + tap_mosaic(known, 0, 1)) * 0.5f;
    const vf diagonal = ((tap_mosaic(known, -1, -1) + tap_mosaic(known, 1, -1)) +
                         (tap_mosaic(known, -1, 1) + tap_mosaic(known, 1, 1))) * 0.25f;
    const vi red_column = in_red_column(at, pattern);
    differences v;
    if (in_red_row(at, pattern)) {
        v.red = red_column ? centre : horizontal;
        v.blue = red_column ? diagonal : vertical;
    } else {
        v.red = red_column ? vertical : diagonal;
        v.blue = red_column ? horizontal : centre;
    }
    return v;
}

// Freeman (US patent 4,724,395, 1988): the colour differences are median filtered, the samples
// that the sensor took are kept, and the other colours follow from them.
INLINE rgb freeman(site at, src_image src, image spread, cfa pattern) {
    const vf red = median_around(spread.plane0, spread, 3);
    const vf blue = median_around(spread.plane1, spread, 3);
    const vf centre = src_tap(src, 0, 0);
    const vf green = by_site(at, pattern, centre - red, centre, centre - blue);
    const vf r = green + red, b = green + blue;
    const rgb v = {by_site(at, pattern, centre, r, r), green, by_site(at, pattern, b, b, centre)};
    return v;
}
