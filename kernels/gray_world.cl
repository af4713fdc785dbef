#include "site_gains.cl"
#include "lib/lights.h"
// Gray world (Buchsbaum 1980): gains that make the means of the three colours equal.
// Samples are summed as integers in steps of 2^-20, clipped to -1..1.
INLINE vi gray_world_sample(vf y, site at) {
    return to_int(nearest(vmin(vmax(y, (vf)(-1.0f)), (vf)(1.0f)) * 1048576.0f));
}

INLINE void gray_world(long4 sums, cfa pattern, __global const float *lights, int light_count,
                       float light_tolerance, extent e, __global float *estimates) {
    const long even_x = (e.width + 1) / 2, odd_x = e.width / 2;
    const long even_y = (e.height + 1) / 2, odd_y = e.height / 2;
    const long sum[4] = {sums.x, sums.y, sums.z, sums.w};
    const long count[4] = {even_x * even_y, odd_x * even_y, even_x * odd_y, odd_x * odd_y};
    const uint red = pattern.red_x + 2 * pattern.red_y, blue = 3 - red;
    const uint green1 = red ^ 1, green2 = blue ^ 1;
    const float green = (float)(sum[green1] + sum[green2]) / (float)(count[green1] + count[green2]);
    // A colour without light, or without a site in a tiny image, gets the gain 1.
    const bool green_lit = sum[green1] + sum[green2] > 0;
    estimates[0] = green_lit && sum[red] > 0 ? green / ((float)sum[red] / (float)count[red]) : 1.0f;
    estimates[1] = green_lit && sum[blue] > 0 ? green / ((float)sum[blue] / (float)count[blue]) : 1.0f;
    limit_to_lights(estimates, lights, light_count, light_tolerance);
}
