// Demosaicing with directional filtering and a posteriori decision (Menon, Andriani and Calvagno
// 2007), with their refinement step, in four passes. "Own" is the colour of a red or blue site, and
// "other" is blue at a red site and red at a blue site.

// Own minus green, with green interpolated along the row and along the column by Hamilton and
// Adams' filter; 0 at green sites.
INLINE pair directional_differences(site at, src_image src, cfa pattern) {
    const vf centre = src_tap(src, 0, 0);
    const vf green_x = (src_tap(src, -1, 0) + src_tap(src, 1, 0)) * 0.5f +
                       (2.0f * centre - src_tap(src, -2, 0) - src_tap(src, 2, 0)) * 0.25f;
    const vf green_y = (src_tap(src, 0, -1) + src_tap(src, 0, 1)) * 0.5f +
                       (2.0f * centre - src_tap(src, 0, -2) - src_tap(src, 0, 2)) * 0.25f;
    const vf zero = (vf)(0.0f);
    const pair v = {by_site(at, pattern, centre - green_x, zero, centre - green_x),
                    by_site(at, pattern, centre - green_y, zero, centre - green_y)};
    return v;
}

// Chooses the direction in which differences change less: horizontal ones along five rows, vertical
// ones along five columns; the row if both are equal. The first plane is the chosen difference, 0
// at green sites. The second is 1 where the row was chosen, else 0.
INLINE pair decide(site at, image both) {
#define CHANGE_X(x0, x1, y) magnitude(tap_pair(both, x0, y).first - tap_pair(both, x1, y).first)
#define CHANGE_Y(y0, y1, x) magnitude(tap_pair(both, x, y0).second - tap_pair(both, x, y1).second)
    const vf change_x = 3.0f * (CHANGE_X(-2, 0, 0) + CHANGE_X(0, 2, 0)) +
                        (CHANGE_X(-1, 1, -1) + CHANGE_X(-1, 1, 1)) +
                        ((CHANGE_X(-2, 0, -2) + CHANGE_X(0, 2, -2)) +
                         (CHANGE_X(-2, 0, 2) + CHANGE_X(0, 2, 2)));
    const vf change_y = 3.0f * (CHANGE_Y(-2, 0, 0) + CHANGE_Y(0, 2, 0)) +
                        (CHANGE_Y(-1, 1, -1) + CHANGE_Y(-1, 1, 1)) +
                        ((CHANGE_Y(-2, 0, -2) + CHANGE_Y(0, 2, -2)) +
                         (CHANGE_Y(-2, 0, 2) + CHANGE_Y(0, 2, 2)));
#undef CHANGE_X
#undef CHANGE_Y
    const vi in_row = change_y >= change_x;
    const pair here = tap_pair(both, 0, 0);
    const pair v = {in_row ? here.first : here.second, in_row ? (vf)(1.0f) : (vf)(0.0f)};
    return v;
}

// Own minus green and own minus other at the two green sites next to a red or blue one, in its
// chosen direction. The difference at a green site is the mean of those in `known` at its two
// adjacent sites.
typedef struct { vf own_green1, own_green2, own_other1, own_other2; } neighbours;

INLINE neighbours at_neighbours(image known, vi in_row) {
    const vf centre = tap_mosaic(known, 0, 0);
    const vf west = (tap_mosaic(known, -2, 0) + centre) * 0.5f;
    const vf east = (centre + tap_mosaic(known, 2, 0)) * 0.5f;
    const vf north = (tap_mosaic(known, 0, -2) + centre) * 0.5f;
    const vf south = (centre + tap_mosaic(known, 0, 2)) * 0.5f;
    const vf nw = tap_mosaic(known, -1, -1), ne = tap_mosaic(known, 1, -1);
    const vf sw = tap_mosaic(known, -1, 1), se = tap_mosaic(known, 1, 1);
    neighbours v;
    v.own_green1 = in_row ? west : north;
    v.own_green2 = in_row ? east : south;
    v.own_other1 = v.own_green1 - (nw + (in_row ? sw : ne)) * 0.5f;
    v.own_other2 = v.own_green2 - ((in_row ? ne : sw) + se) * 0.5f;
    return v;
}

#define THIRD 0.33333334f

// Refinement, first half: own minus green as the mean of three values along the direction, and a
// first estimate of own minus other.
INLINE pair refine(site at, image chosen, cfa pattern) {
    const vf centre = tap_mosaic(chosen, 0, 0);
    const neighbours b = at_neighbours(chosen, tap_pair(chosen, 0, 0).second > 0.5f);
    const vf own_green = (b.own_green1 + centre + b.own_green2) * THIRD;
    const vf own_other = (b.own_other1 + b.own_other2) * 0.5f;
    const pair v = {by_site(at, pattern, own_green, centre, own_green), own_other};
    return v;
}

// Refinement, second half: red and blue at green sites from bilinear differences. The other colour
// at red and blue sites comes from own minus other, as the mean of three values along the
// direction.
INLINE rgb interpolate(site at, src_image src, image chosen, image refined, cfa pattern) {
    const vf centre = src_tap(src, 0, 0);
    const pair here = tap_pair(refined, 0, 0);
    const neighbours b = at_neighbours(refined, tap_pair(chosen, 0, 0).second > 0.5f);
    const vf other = centre - (b.own_other1 + here.second + b.own_other2) * THIRD;
    const vf in_row = (tap_mosaic(refined, -1, 0) + tap_mosaic(refined, 1, 0)) * 0.5f;
    const vf in_column = (tap_mosaic(refined, 0, -1) + tap_mosaic(refined, 0, 1)) * 0.5f;
    const pair colours =
        red_and_blue(at, pattern, centre, centre + in_row, centre + in_column, other);
    const rgb v = {colours.first, centre - here.first, colours.second};
    return v;
}
