// Depth of field: light is spread over discs, and nearer surfaces occlude farther ones. Tap k is
// four numbers: its offset to the right and down, the radius of a disc whose edge is there, and its
// weight for hidden surfaces. `radii` has the radii of all pixels of the whole image, negative if
// nearer than the focus distance. It has `reach` mirrored pixels on every side and one more vector
// at the right. For an image larger than `radii`, as in a check of the kernel, the last row and
// vector are repeated.
typedef struct { rgb light; vf total; } surface;

INLINE void add(surface *to, vf share, rgb c) {
    to->light.r += share * c.r;
    to->light.g += share * c.g;
    to->light.b += share * c.b;
    to->total += share;
}

INLINE vf unit(vf x) { return vmin(vmax(x, (vf)(0.0f)), (vf)(1.0f)); }

INLINE vf area(vf radius) { return vmax(radius + 0.5f, 3.14159265f * (radius * radius) + 0.261799388f); }

INLINE rgb defocus(site at, src_image src, __global const float *radii, int columns, int rows, int reach,
                   __global const float *taps, int count) {
    const int last_x = columns - 2 * reach - LANES, last_y = rows - 2 * reach - 1;
    const int x = (int)at.x < last_x ? (int)at.x : last_x, y = (int)at.y < last_y ? (int)at.y : last_y;
    __global const float *here = radii + (long)(y + reach) * columns + (x + reach);
    const vf own = load(here), size = vmax(own, -own), own_area = area(size);
    const vf none = (vf)(0.0f), all = (vf)(1.0f);
    surface front = {{none, none, none}, none}, level = front, behind = front;
    vf free = none;
    for (int k = 0; k < count; ++k) {
        __global const float *tap = taps + 4 * k;
        const int dx = (int)tap[0], dy = (int)tap[1];
        const float soft = 0.5f - tap[2];
        const vf there = load(here + (long)dy * columns + dx);
        const vf disc = vmax(there, -there), weight = unit(disc + soft) / area(disc);
        const vf nearer = unit(own - there), farther = unit(there - own);
        const rgb c = src_tap(src, dx, dy);
        add(&front, nearer * weight, c);
        add(&level, (all - nearer - farther) * weight, c);
        add(&behind, farther * (weight + tap[3]), c);
        free += (all - nearer) * (unit(size + soft) / own_area);
    }
    const vi seen = behind.total > none;
    const vf left = all - vmin(front.total, all);
    const vf covered = seen ? left * vmin(level.total / free, all) : left;
    const vf of_front = all / vmax(front.total, all), of_level = covered / level.total;
    const vf of_behind = (left - covered) / (seen ? behind.total : all);
    const rgb spread = {front.light.r * of_front + level.light.r * of_level + behind.light.r * of_behind,
                        front.light.g * of_front + level.light.g * of_level + behind.light.g * of_behind,
                        front.light.b * of_front + level.light.b * of_level + behind.light.b * of_behind};
    return spread;
}
