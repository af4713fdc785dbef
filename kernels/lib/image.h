// Where a block of lanes stands, and how lanes are read from and written to images.
//
// A stored image is one to three planes of float32. Its rows are `pitch` apart, and it is surrounded
// by a border of BORDER pixels that mirrors the image (reflect-101: the edge pixel is not repeated,
// so the Bayer pattern continues in the border). Whatever writes a pixel also writes its mirror
// images in the border, so a stencil never has to check where it is.
#ifndef CLPIPE_IMAGE_H
#define CLPIPE_IMAGE_H

typedef struct {
    uint x, y;  // of the first lane
    vi odd;     // -1 in the lanes whose column is odd, else 0
} site;

// Stored is the whole image or a tile of it with its halo. A site is a place in the image, and `left`,
// `top` is where the planes begin in it. A tile has a border too; at edges that are not the image's it
// mirrors pixels that nothing uses, because the halo is wide enough.
typedef struct {
    uint width, height;  // of the image
    uint pitch;
    uint left, top;      // of the planes, in the image; in whole blocks
    uint columns, rows;  // of the planes
} extent;

// The pixels of a tile without its halo.
typedef struct { uint left, top, right, bottom; } core;

typedef struct { vf r, g, b; } rgb;
typedef struct { vf y, cb, cr; } ycbcr;
typedef struct { vf first, second; } pair;

// Planes of a stored image, each pointing at the first lane of the block's first row, and the current
// row of the block. All rows tap from the same pointers, so that the compiler sees which taps of two
// rows are the same, and loads them once.
typedef struct {
    __global const float *plane0, *plane1, *plane2;
    uint pitch;
    int row;
    site at;
} image;

INLINE site site_at(uint x, uint y) {
    // x is a multiple of LANES, so with two lanes or more the parity of each lane is a constant.
    const site at = {x, y, -((iota() + (vi)((int)(LANES == 1 ? x : 0))) & 1)};
    return at;
}

INLINE site shifted(site at, int dx, int dy) {
    const site to = {at.x + dx, at.y + dy, (dx & 1) ? ~at.odd : at.odd};
    return to;
}

// The index of a pixel in images without border and padding: the source and the result.
INLINE size_t pixel_number(site at, extent e) {
    return (size_t)(at.y - e.top) * e.columns + (at.x - e.left);
}

INLINE size_t plane_offset(site at, extent e) {
    return (size_t)(at.y - e.top + BORDER) * e.pitch + BORDER_LEFT + (at.x - e.left);
}

// The address that the image's first pixel would have, from which places in the image are counted.
INLINE __global const float *image_origin(__global const float *plane, extent e) {
    return plane + ((long)BORDER - (long)e.top) * (long)e.pitch + BORDER_LEFT - (long)e.left;
}

INLINE image image_at(__global const float *p0, __global const float *p1, __global const float *p2,
                      extent e, site first, uint row) {
    const size_t offset = plane_offset(first, e);
    const site at = {first.x, first.y + row, first.odd};
    const image i = {p0 + offset, p1 + offset, p2 + offset, e.pitch, (int)row, at};
    return i;
}

INLINE vf tap_plane(__global const float *plane, image i, int dx, int dy) {
    return load(plane + (long)(i.row + dy) * (long)i.pitch + dx);
}
#define TAP(plane) tap_plane(i.plane, i, dx, dy)
INLINE vf tap_mosaic(image i, int dx, int dy) { return TAP(plane0); }
INLINE pair tap_pair(image i, int dx, int dy) {
    const pair v = {TAP(plane0), TAP(plane1)};
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

// The pixel (0..n-1) that reflect-101 puts at index i.
INLINE int mirror(int i, int n) {
    if (n == 1) return 0;
    const int period = 2 * (n - 1);
    i %= period;
    if (i < 0) i += period;
    return i < n ? i : period - i;
}

// Stores one lane's value in its column and in that column's mirror images, all in one row.
INLINE void store_lane(float v, __global float *row, int x, int width) {
    row[x] = v;
    for (int a = 1; a <= BORDER; ++a) {
        if (mirror(-a, width) == x) row[-a] = v;
        if (mirror(width - 1 + a, width) == x) row[width - 1 + a] = v;
    }
}

static void store_row(vf v, __global float *row, int x, int width) {
    if (x > BORDER && x + LANES + BORDER < width) {
        store(v, row + x);
        return;
    }
    float lanes[LANES];
    spill(v, lanes);
    for (int k = 0; k < LANES && x + k < width; ++k) store_lane(lanes[k], row, x + k, width);
}

// `x` and `y` are counted from where the planes begin.
static void store_at_edge(vf v, __global float *dst, int x, int y, extent e) {
    const int columns = (int)e.columns, rows = (int)e.rows;
    __global float *origin = dst + (size_t)BORDER * e.pitch + BORDER_LEFT;
    store_row(v, origin + (long)y * e.pitch, x, columns);
    for (int a = 1; a <= BORDER; ++a) {
        if (mirror(-a, rows) == y) store_row(v, origin - (long)a * e.pitch, x, columns);
        if (mirror(rows - 1 + a, rows) == y)
            store_row(v, origin + (long)(rows - 1 + a) * e.pitch, x, columns);
    }
}

INLINE bool near_edge(uint x, uint y, extent e) {
    return x <= BORDER || x + LANES + BORDER >= e.columns || y <= BORDER || y + 1 + BORDER >= e.rows;
}

INLINE void store_plane(vf v, __global float *dst, site at, extent e) {
    const uint x = at.x - e.left, y = at.y - e.top;
    if (near_edge(x, y, e)) {
        if (y < e.rows) store_at_edge(v, dst, (int)x, (int)y, e);
    } else {
        store(v, dst + plane_offset(at, e));
    }
}

INLINE void store_mosaic(vf v, __global float *p0, site at, extent e) { store_plane(v, p0, at, e); }
INLINE void store_pair(pair v, __global float *p0, __global float *p1, site at, extent e) {
    store_plane(v.first, p0, at, e);
    store_plane(v.second, p1, at, e);
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
