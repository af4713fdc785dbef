// Demosaicing that invents nothing: every missing sample lies between its neighbours of that colour.
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

// Red and blue from colour differences, between the least and the greatest neighbour of that colour.
INLINE rgb bounded_red_and_blue(site at, image roots, image known, cfa pattern,
                                float offset) {
    const vf centre = tap_mosaic(roots, 0, 0);
    const vf west = tap_mosaic(roots, -1, 0), east = tap_mosaic(roots, 1, 0);
    const vf north = tap_mosaic(roots, 0, -1), south = tap_mosaic(roots, 0, 1);
    const vf one = tap_mosaic(roots, -1, -1), two = tap_mosaic(roots, 1, -1);
    const vf three = tap_mosaic(roots, -1, 1), four = tap_mosaic(roots, 1, 1);
    const vf least = vmin(vmin(one, two), vmin(three, four));
    const vf most = vmax(vmax(one, two), vmax(three, four));
    const pair low = red_and_blue(at, pattern, centre, vmin(west, east), vmin(north, south), least);
    const pair high = red_and_blue(at, pattern, centre, vmax(west, east), vmax(north, south), most);
    rgb c = from_differences(at, pattern, centre, spread_differences(at, known, pattern));
    c.r = vmin(vmax(c.r, low.first), high.first);
    c.b = vmin(vmax(c.b, low.second), high.second);
    return from_roots(c, offset);
}
