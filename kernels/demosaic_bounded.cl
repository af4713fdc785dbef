// Demosaicing that bounds what it invents by the samples around.
#include "lib/demosaic.h"
#include "lib/roots.h"

// Differences of colour reach below black where one colour is dark, and are as large as the light
// itself where it is bright; in roots both are tame.
INLINE vf to_roots(vf y, site at, float offset) { return root_of(y, offset); }

INLINE vf between(vf v, vf a, vf b) { return vmin(vmax(v, vmin(a, b)), vmax(a, b)); }

// Green as Hamilton and Adams (1997) interpolate it, in both directions; each is kept between its two
// neighbours, and weighs by the other's squared gradient. `even` is the square of a gradient below
// which both directions are alike. The result is one plane: green at green sites, R-G at red sites
// and B-G at blue sites.
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
    return by_site(at, pattern, centre - green, centre, centre - green);
}

typedef struct { vf low, high; } bounds;

INLINE bounds extended(bounds b, vf v) {
    const bounds w = {vmin(b.low, v), vmax(b.high, v)};
    return w;
}

// How far red or blue may go: as far as its neighbours do, and beyond them by as much as green here
// goes beyond green there, less what noise may do. A line narrower than the pattern is an extreme of
// green, too; where a colour ends green only rises or falls.
INLINE bounds with_excess(bounds colour, bounds green, vf here, float noise) {
    const bounds v = {colour.low + vmin(here - green.low + noise, (vf)(0.0f)),
                      colour.high + vmax(here - green.high - noise, (vf)(0.0f))};
    return v;
}

// Red and blue from colour differences, within bounds.
INLINE rgb bounded_red_and_blue(site at, image roots, image known, cfa pattern, float offset,
                                float noise) {
    rgb c = from_differences(at, pattern, tap_mosaic(roots, 0, 0),
                             spread_differences(at, known, pattern));
    bounds colour[3], green[3];  // in the row, in the column, at the corners
#pragma unroll
    for (int i = 0; i < 8; ++i) {
        const int set = i / 2 < 2 ? i / 2 : 2, sign = i & 1 ? 1 : -1;
        const int dx = set == 1 ? 0 : sign, dy = set == 0 ? 0 : set == 1 ? sign : i < 6 ? -1 : 1;
        const vf sample = tap_mosaic(roots, dx, dy), other = sample - tap_mosaic(known, dx, dy);
        const bounds first = {sample, sample}, first_green = {other, other};
        const bool begins = i == 0 || i == 2 || i == 4;
        colour[set] = begins ? first : extended(colour[set], sample);
        green[set] = begins ? first_green : extended(green[set], other);
    }
#pragma unroll
    for (int set = 0; set < 3; ++set) colour[set] = with_excess(colour[set], green[set], c.g, noise);
    const vf own = tap_mosaic(roots, 0, 0);
    const pair low =
        red_and_blue(at, pattern, own, colour[0].low, colour[1].low, colour[2].low);
    const pair high =
        red_and_blue(at, pattern, own, colour[0].high, colour[1].high, colour[2].high);
    c.r = vmin(vmax(c.r, low.first), high.first);
    c.b = vmin(vmax(c.b, low.second), high.second);
    return from_roots(c, offset);
}
