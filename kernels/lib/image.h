// Where a block of lanes stands, and how lanes are read from and written to images.
//
// A stored image is one to three planes of float32. Its rows are `pitch` apart and it is
// surrounded by an apron of APRON pixels that mirrors the image (reflect-101: the edge pixel is
// not repeated, so the phase of a Bayer pattern goes on). Whoever writes a pixel writes its mirror
// images in the apron too, so a stencil never has to look where it is.
#ifndef CLPIPE_IMAGE_H
#define CLPIPE_IMAGE_H

typedef struct {
    uint x, y;  // of the first lane
    vi odd;     // -1 in the lanes whose column is odd, else 0
} site;

typedef struct {
    uint width, height, pitch;
} extent;

typedef struct { vf r, g, b; } rgb;
typedef struct { vf y, cb, cr; } ycbcr;
typedef struct { vf red, blue; } differences;  // R-G and B-G
typedef struct { vf signal, stable; } stabilized;  // a sample, and a function of it

// Planes of a stored image, each pointing at the block's first lane.
typedef struct {
    __global const float *plane0, *plane1, *plane2;
    uint pitch;
    site at;
} image;

INLINE site site_at(uint x, uint y) {
    // x is a multiple of LANES, so from two lanes up the parity of a lane is a constant.
    const site at = {x, y, -((iota() + (vi)((int)(LANES == 1 ? x : 0))) & 1)};
    return at;
}

INLINE site shifted(site at, int dx, int dy) {
    const site to = {at.x + dx, at.y + dy, (dx & 1) ? ~at.odd : at.odd};
    return to;
}

INLINE size_t plane_offset(site at, uint pitch) {
    return (size_t)(at.y + APRON) * pitch + APRON_LEFT + at.x;
}

INLINE image image_at(__global const float *p0, __global const float *p1, __global const float *p2,
                      uint pitch, site at) {
    const size_t offset = plane_offset(at, pitch);
    const image i = {p0 + offset, p1 + offset, p2 + offset, pitch, at};
    return i;
}

#define TAP(plane) load(i.plane + (long)dy * (long)i.pitch + dx)
INLINE vf tap_mosaic(image i, int dx, int dy) { return TAP(plane0); }
INLINE differences tap_differences(image i, int dx, int dy) {
    const differences v = {TAP(plane0), TAP(plane1)};
    return v;
}
INLINE stabilized tap_stabilized(image i, int dx, int dy) {
    const stabilized v = {TAP(plane0), TAP(plane1)};
    return v;
}
INLINE rgb tap_rgb(image i, int dx, int dy) {
    const rgb v = {TAP(plane0), TAP(plane1), TAP(plane2)};
    return v;
}
INLINE ycbcr tap_ycbcr(image i, int dx, int dy) {
    const ycbcr v = {TAP(plane0), TAP(plane1), TAP(plane2)};
    return v;
}
#undef TAP

// The pixel of 0..n-1 that reflect-101 shows at place i.
INLINE int mirror(int i, int n) {
    if (n == 1) return 0;
    const int period = 2 * (n - 1);
    i %= period;
    if (i < 0) i += period;
    return i < n ? i : period - i;
}

// One lane's value to its column and to that column's mirror images, all in one row.
INLINE void store_lane(float v, __global float *row, int x, int width) {
    row[x] = v;
    for (int a = 1; a <= APRON; ++a) {
        if (mirror(-a, width) == x) row[-a] = v;
        if (mirror(width - 1 + a, width) == x) row[width - 1 + a] = v;
    }
}

static void store_row(vf v, __global float *row, int x, int width) {
    if (x > APRON && x + LANES + APRON < width) {
        store(v, row + x);
        return;
    }
    float lanes[LANES];
    spill(v, lanes);
    for (int k = 0; k < LANES && x + k < width; ++k) store_lane(lanes[k], row, x + k, width);
}

static void store_at_edge(vf v, __global float *dst, int x, int y, extent e) {
    const int height = (int)e.height;
    __global float *origin = dst + (size_t)APRON * e.pitch + APRON_LEFT;
    store_row(v, origin + (long)y * e.pitch, x, (int)e.width);
    for (int a = 1; a <= APRON; ++a) {
        if (mirror(-a, height) == y) store_row(v, origin - (long)a * e.pitch, x, (int)e.width);
        if (mirror(height - 1 + a, height) == y)
            store_row(v, origin + (long)(height - 1 + a) * e.pitch, x, (int)e.width);
    }
}

INLINE bool near_edge(site at, extent e) {
    return at.x <= APRON || at.x + LANES + APRON >= e.width || at.y <= APRON ||
           at.y + 1 + APRON >= e.height;
}

INLINE void store_plane(vf v, __global float *dst, site at, extent e) {
    if (near_edge(at, e)) {
        if (at.y < e.height) store_at_edge(v, dst, (int)at.x, (int)at.y, e);
    } else {
        store(v, dst + plane_offset(at, e.pitch));
    }
}

INLINE void store_mosaic(vf v, __global float *p0, site at, extent e) { store_plane(v, p0, at, e); }
INLINE void store_differences(differences v, __global float *p0, __global float *p1, site at,
                              extent e) {
    store_plane(v.red, p0, at, e);
    store_plane(v.blue, p1, at, e);
}
INLINE void store_stabilized(stabilized v, __global float *p0, __global float *p1, site at,
                             extent e) {
    store_plane(v.signal, p0, at, e);
    store_plane(v.stable, p1, at, e);
}
INLINE void store_rgb(rgb v, __global float *p0, __global float *p1, __global float *p2, site at,
                      extent e) {
    store_plane(v.r, p0, at, e);
    store_plane(v.g, p1, at, e);
    store_plane(v.b, p2, at, e);
}
INLINE void store_ycbcr(ycbcr v, __global float *p0, __global float *p1, __global float *p2,
                        site at, extent e) {
    store_plane(v.y, p0, at, e);
    store_plane(v.cb, p1, at, e);
    store_plane(v.cr, p2, at, e);
}

#endif
