// Demosaicing with linear 5x5 filters (Malvar, He and Cutler 2004): bilinear, corrected by the
// Laplacian of the site's own colour, with gains of 1/2 (green), 5/8 (red and blue at green sites)
// and 3/4 (red at blue sites, blue at red sites).
INLINE rgb malvar2004(site at, src_image src, cfa pattern) {
    const vf centre = src_tap(src, 0, 0);
    const vf near_x = src_tap(src, -1, 0) + src_tap(src, 1, 0);
    const vf near_y = src_tap(src, 0, -1) + src_tap(src, 0, 1);
    const vf far_x = src_tap(src, -2, 0) + src_tap(src, 2, 0);
    const vf far_y = src_tap(src, 0, -2) + src_tap(src, 0, 2);
    const vf corners = (src_tap(src, -1, -1) + src_tap(src, 1, -1)) +
                       (src_tap(src, -1, 1) + src_tap(src, 1, 1));
    const vf far = far_x + far_y;
    const vf green = (4.0f * centre + 2.0f * (near_x + near_y) - far) * 0.125f;
    const vf at_green = 5.0f * centre - corners;
    const vf in_row = (at_green + 4.0f * near_x - far_x + 0.5f * far_y) * 0.125f;
    const vf in_column = (at_green + 4.0f * near_y - far_y + 0.5f * far_x) * 0.125f;
    const vf across = (6.0f * centre + 2.0f * corners - 1.5f * far) * 0.125f;
    const pair colours = red_and_blue(at, pattern, centre, in_row, in_column, across);
    const rgb v = {colours.first, by_site(at, pattern, green, centre, green), colours.second};
    return v;
}
