// Edge-directed demosaicing: green along the edge, not across it; then red and blue by bilinear
// colour differences.
enum { HAMILTON_ADAMS, LAROCHE_PRESCOTT, HIBBARD };

// Green from the direction with the smaller gradient; equal gradients take the mean of both. The
// classifier defines the gradient: the change of green (Hibbard 1995), the second derivative of the
// site's own colour (Laroche and Prescott 1994), or the sum of both (Hamilton and Adams 1997).
// Hamilton and Adams also add a quarter of that derivative to green. The result is one plane: R-G
// at red sites, B-G at blue sites, and 0 at green sites. In an image of one row or column, the taps
// for the missing colour hit green sites.
INLINE vf green_or_difference(site at, src_image src, cfa pattern, int classifier) {
    const vf centre = src_tap(src, 0, 0);
    const vf west = src_tap(src, -1, 0), east = src_tap(src, 1, 0);
    const vf north = src_tap(src, 0, -1), south = src_tap(src, 0, 1);
    const vf bend_x = 2.0f * centre - src_tap(src, -2, 0) - src_tap(src, 2, 0);
    const vf bend_y = 2.0f * centre - src_tap(src, 0, -2) - src_tap(src, 0, 2);
    vf green_x = (west + east) * 0.5f, green_y = (north + south) * 0.5f;
    vf gradient_x, gradient_y;
    if (classifier == HIBBARD) {
        gradient_x = magnitude(west - east);
        gradient_y = magnitude(north - south);
    } else if (classifier == LAROCHE_PRESCOTT) {
        gradient_x = magnitude(bend_x);
        gradient_y = magnitude(bend_y);
    } else {
        gradient_x = magnitude(west - east) + magnitude(bend_x);
        gradient_y = magnitude(north - south) + magnitude(bend_y);
        green_x += bend_x * 0.25f;
        green_y += bend_y * 0.25f;
    }
    const vf either = (green_x + green_y) * 0.5f;
    const vf green = gradient_x < gradient_y ? green_x : gradient_y < gradient_x ? green_y : either;
    return by_site(at, pattern, centre - green, (vf)(0.0f), centre - green);
}

INLINE rgb add_differences(site at, src_image src, image known, cfa pattern) {
    return from_differences(at, pattern, src_tap(src, 0, 0),
                            spread_differences(at, known, pattern));
}
