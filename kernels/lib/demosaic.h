// Functions that demosaicing methods share: values by site, and colours from colour differences.
#ifndef CLPIPE_DEMOSAIC_H
#define CLPIPE_DEMOSAIC_H

// Red and blue at any site, chosen from four values. At red and blue sites, `own` is for the site's
// own colour and `across` for the other one (blue at red sites, red at blue sites). At green sites,
// `in_row` is for the colour, red or blue, whose sites are in that row, and `in_column` for the
// other.
INLINE pair red_and_blue(site at, cfa pattern, vf own, vf in_row, vf in_column, vf across) {
    const vi red_column = in_red_column(at, pattern);
    pair v;
    if (in_red_row(at, pattern)) {
        v.first = red_column ? own : in_row;
        v.second = red_column ? across : in_column;
    } else {
        v.first = red_column ? in_column : across;
        v.second = red_column ? in_row : own;
    }
    return v;
}

// Colour differences R-G and B-G at every pixel, by bilinear interpolation. Plane 0 of `known` holds
// R-G at red sites and B-G at blue sites.
INLINE pair spread_differences(site at, image known, cfa pattern) {
    const vf in_row = (tap_mosaic(known, -1, 0) + tap_mosaic(known, 1, 0)) * 0.5f;
    const vf in_column = (tap_mosaic(known, 0, -1) + tap_mosaic(known, 0, 1)) * 0.5f;
    const vf across = ((tap_mosaic(known, -1, -1) + tap_mosaic(known, 1, -1)) +
                       (tap_mosaic(known, -1, 1) + tap_mosaic(known, 1, 1))) * 0.25f;
    return red_and_blue(at, pattern, tap_mosaic(known, 0, 0), in_row, in_column, across);
}

// RGB from the sensor's sample, R-G and B-G. The sample does not change.
INLINE rgb from_differences(site at, cfa pattern, vf sample, pair differences) {
    const vf red = differences.first, blue = differences.second;
    const vf green = by_site(at, pattern, sample - red, sample, sample - blue);
    const vf r = green + red, b = green + blue;
    const rgb v = {by_site(at, pattern, sample, r, r), green, by_site(at, pattern, b, b, sample)};
    return v;
}

#endif
