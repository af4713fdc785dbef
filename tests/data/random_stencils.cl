#include "random_passes.cl"
// A function that taps the image that its stage reads, which only a launch with a stencil has.
INLINE rgb around(site at, src_image src, int reach) {
    const rgb a = src_tap(src, -reach, 0), b = src_tap(src, reach, 0);
    const rgb c = src_tap(src, 0, -reach), d = src_tap(src, 0, reach);
    const rgb v = {((a.r + b.r) + (c.r + d.r)) * 0.25f, ((a.g + b.g) + (c.g + d.g)) * 0.25f,
                   ((a.b + b.b) + (c.b + d.b)) * 0.25f};
    return v;
}
