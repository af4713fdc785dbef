// Light spread over discs. Tap k is three numbers: how far it is to the right and down, and the radius at
// which a disc's edge is there. `radii` has those of all pixels of the whole image, below 0 in front of
// what is in focus, with `reach` mirrored pixels on every side and a vector more at the right. An image larger
// than it, as one that kernels are tried on, repeats its last row and vector.
INLINE rgb defocus(site at, src_image src, __global const float *radii, int columns, int rows, int reach,
                   __global const float *taps, int count) {
    const int last_x = columns - 2 * reach - LANES, last_y = rows - 2 * reach - 1;
    const int x = (int)at.x < last_x ? (int)at.x : last_x, y = (int)at.y < last_y ? (int)at.y : last_y;
    __global const float *here = radii + (long)(y + reach) * columns + (x + reach);
    const vf own = load(here), size = vmax(own, -own);
    rgb light = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    vf total = (vf)(0.0f);
    for (int k = 0; k < count; ++k) {
        __global const float *tap = taps + 3 * k;
        const int dx = (int)tap[0], dy = (int)tap[1];
        const vf there = load(here + (long)dy * columns + dx);
        vf disc = vmax(there, -there);
        disc = there > own ? vmin(disc, size) : disc;
        const vf cover = vmin(vmax(disc + (0.5f - tap[2]), (vf)(0.0f)), (vf)(1.0f));
        const vf weight = cover / vmax(disc + 0.5f, 3.14159265f * (disc * disc) + 0.261799388f);
        const rgb c = src_tap(src, dx, dy);
        light.r += weight * c.r;
        light.g += weight * c.g;
        light.b += weight * c.b;
        total += weight;
    }
    const rgb spread = {light.r / total, light.g / total, light.b / total};
    return spread;
}
