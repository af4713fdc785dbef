// What demosaicing methods share: values by site, and colours from colour differences.
#ifndef CLPIPE_DEMOSAIC_H
#define CLPIPE_DEMOSAIC_H

// Two colours (red first) at any site. `own` is the site's own where that is red or blue, `across`
// the other one there; at green sites `in_row` is that of the two that stands in the site's row,
// `in_column` the one that stands in its column.
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

// Colour differences R-G and B-G at every pixel, bilinear from plane 0 of an image that holds them
// at red and blue sites.
INLINE pair spread_differences(site at, image known, cfa pattern) {
    const vf in_row = (tap_mosaic(known, -1, 0) + tap_mosaic(known, 1, 0)) * 0.5f;
    const vf in_column = (tap_mosaic(known, 0, -1) + tap_mosaic(known, 0, 1)) * 0.5f;
    const vf across = ((tap_mosaic(known, -1, -1) + tap_mosaic(known, 1, -1)) +
                       (tap_mosaic(known, -1, 1) + tap_mosaic(known, 1, 1))) * 0.25f;
    return red_and_blue(at, pattern, tap_mosaic(known, 0, 0), in_row, in_column, across);
}

// The sample that the sensor took, and the other colours that follow from it and from R-G and B-G.
INLINE rgb from_differences(site at, cfa pattern, vf sample, pair differences) {
    const vf red = differences.first, blue = differences.second;
    const vf green = by_site(at, pattern, sample - red, sample, sample - blue);
    const vf r = green + red, b = green + blue;
    const rgb v = {by_site(at, pattern, sample, r, r), green, by_site(at, pattern, b, b, sample)};
    return v;
}

#endif
