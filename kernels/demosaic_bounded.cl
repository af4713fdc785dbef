// Demosaicing that limits interpolated colours by the surrounding samples.
#include "lib/demosaic.h"
#include "lib/roots.h"

// In linear light, colour differences fall below black where one colour is dark, and are as large
// as the light where it is bright. In roots, both effects are small.
INLINE vf to_roots(vf y, site at, float offset) { return root_of(y, offset); }

INLINE vf between(vf v, vf a, vf b) { return vmin(vmax(v, vmin(a, b)), vmax(a, b)); }

// Green by the interpolation of Hamilton and Adams (1997), in both directions. Each value is
// limited to the range of its two neighbours, and is weighted by the other's squared gradient.
// `even` is the square of a gradient below which both directions count as alike. The result is one
// plane: R-G at red sites, B-G at blue sites, and 0 at green sites. In an image of one row or
// column, the taps for the missing colour hit green sites.
INLINE vf bounded_green(site at, image roots, cfa pattern, float even) {
#pragma OPENCL FP_CONTRACT ON
    const vf centre = tap_mosaic(roots, 0, 0);
    const vf west = tap_mosaic(roots, -1, 0), east = tap_mosaic(roots, 1, 0);
    const vf north = tap_mosaic(roots, 0, -1), south = tap_mosaic(roots, 0, 1);
    const vf bend_x = 2.0f * centre - tap_mosaic(roots, -2, 0) - tap_mosaic(roots, 2, 0);
    const vf bend_y = 2.0f * centre - tap_mosaic(roots, 0, -2) - tap_mosaic(roots, 0, 2);
    const vf gradient_x = magnitude(west - east) + magnitude(bend_x);
    const vf gradient_y = magnitude(north - south) + magnitude(bend_y);
    const vf green_x = between((west + east) * 0.5f + bend_x * 0.25f, west, east);
    const vf green_y = between((north + south) * 0.5f + bend_y * 0.25f, north, south);
    const vf weight_x = gradient_y * gradient_y + even, weight_y = gradient_x * gradient_x + even;
    const vf green = (green_x * weight_x + green_y * weight_y) / (weight_x + weight_y);
    return by_site(at, pattern, centre - green, (vf)(0.0f), centre - green);
}

typedef struct { vf low, high; } bounds;

INLINE bounds bounds_of(vf a, vf b) {
    const bounds v = {vmin(a, b), vmax(a, b)};
    return v;
}

INLINE bounds both(bounds a, bounds b) {
    const bounds v = {vmin(a.low, b.low), vmax(a.high, b.high)};
    return v;
}

INLINE vf sample_at(image roots, int dx, int dy) { return tap_mosaic(roots, dx, dy); }
INLINE vf green_at(image roots, image known, int dx, int dy) {
    return tap_mosaic(roots, dx, dy) - tap_mosaic(known, dx, dy);
}

// The bounds of red or blue: those of its neighbours, widened by the difference between green at
// this pixel and green at these neighbours, plus or minus noise. A line narrower than the pattern
// is an extreme of green. Where a colour ends, green only rises or falls.
INLINE bounds with_excess(bounds colour, bounds green, vf here, float noise) {
    const bounds v = {colour.low + vmin(here + noise - green.low, (vf)(0.0f)),
                      colour.high + vmax(here - noise - green.high, (vf)(0.0f))};
    return v;
}

// The bounds from two neighbours on opposite sides.
INLINE bounds bounds_from(image roots, image known, int dx, int dy, vf here, float noise) {
    return with_excess(bounds_of(sample_at(roots, -dx, -dy), sample_at(roots, dx, dy)),
                       bounds_of(green_at(roots, known, -dx, -dy), green_at(roots, known, dx, dy)),
                       here, noise);
}

INLINE bounds bounds_from_corners(image roots, image known, vf here, float noise) {
    const bounds colour = both(bounds_of(sample_at(roots, -1, -1), sample_at(roots, 1, -1)),
                               bounds_of(sample_at(roots, -1, 1), sample_at(roots, 1, 1)));
    const bounds green =
        both(bounds_of(green_at(roots, known, -1, -1), green_at(roots, known, 1, -1)),
             bounds_of(green_at(roots, known, -1, 1), green_at(roots, known, 1, 1)));
    return with_excess(colour, green, here, noise);
}

// Red and blue from colour differences, within bounds. The roots of all colours are in steps.
INLINE rgb bounded_red_and_blue(site at, image roots, image known, cfa pattern, float noise) {
    const vf own = tap_mosaic(roots, 0, 0);
    const rgb c = from_differences(at, pattern, own, spread_differences(at, known, pattern));
    const bounds row = bounds_from(roots, known, 1, 0, c.g, noise);
    const bounds column = bounds_from(roots, known, 0, 1, c.g, noise);
    const bounds corners = bounds_from_corners(roots, known, c.g, noise);
    const pair low = red_and_blue(at, pattern, own, row.low, column.low, corners.low);
    const pair high = red_and_blue(at, pattern, own, row.high, column.high, corners.high);
    const vf red = vmin(vmax(c.r, low.first), high.first);
    const vf blue = vmin(vmax(c.b, low.second), high.second);
    const rgb v = {in_steps(red), in_steps(c.g), in_steps(blue)};
    return v;
}
