// The position of a block of lanes, and how lanes are read from and written to images.
//
// A stored image is one to three planes of float32. Its rows are `pitch` apart, and it is
// surrounded by a border of `border` pixels that mirrors the image (reflect-101: the edge pixel is
// not repeated, so the Bayer pattern continues in the border). A function that writes a pixel also
// writes its mirror images in the border, so a stencil never has to check its position.
#ifndef CLPIPE_IMAGE_H
#define CLPIPE_IMAGE_H

typedef struct {
    uint x, y;  // of the first lane
    vi odd;     // -1 in the lanes whose column is odd, else 0
} site;

// The stored part is the whole image, or a tile of it with its halo. A site is a position in the
// image, and `left`, `top` is where the planes begin in it. A tile also has a border. At edges that
// are not the image's, it mirrors pixels that are never used, because the halo is wide enough.
typedef struct {
    uint width, height;  // of the image
    uint pitch;
    uint left, top;      // of the planes, in the image; in whole blocks
    uint columns, rows;  // of the planes
    uint border;         // around the planes, in pixels: as wide as the plan's widest stencil
    uint ring;           // if not 0, planes store only this many rows: row y in place of row y - ring
} extent;

// The pixels of a tile without its halo.
typedef struct { uint left, top, right, bottom; } core;

typedef struct { vf r, g, b; } rgb;
typedef struct { vf y, cb, cr; } ycbcr;
typedef struct { vf first, second; } pair;

// Planes of a stored image, each pointing at the first lane of the block's first row, and the
// current row of the block. All rows tap from the same pointers. The compiler therefore sees which
// taps of two rows are the same, and loads them once.
typedef struct {
    __global const float *plane0, *plane1, *plane2;
    uint pitch;
    int row;
    site at;
    uint ring;
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

// Columns before the first pixel of a row: the border, in whole blocks.
INLINE uint border_left(extent e) { return (e.border + LANES - 1) / LANES * LANES; }

INLINE size_t plane_offset(site at, extent e) {
    return (size_t)(at.y - e.top + e.border) * e.pitch + border_left(e) + (at.x - e.left);
}

INLINE int int_min(int a, int b) { return a < b ? a : b; }
INLINE int int_max(int a, int b) { return a > b ? a : b; }
INLINE int int_clamp(int a, int low, int high) { return int_min(int_max(a, low), high); }

// A GPU, with its single lane, has no rings.
#define IN_RING(planes) (LANES > 1 && (planes).ring)

// Rows from the start of a plane to a row of the image. Rows of the border are negative.
INLINE long ring_row(int y, uint ring) { return (long)((uint)(y + (int)ring) % ring); }

// The address that the image's first pixel would have. Positions in the image start from it.
INLINE __global const float *image_origin(__global const float *plane, extent e) {
    return plane + ((long)e.border - (long)e.top) * (long)e.pitch + (long)border_left(e) -
           (long)e.left;
}

INLINE image image_at(__global const float *p0, __global const float *p1, __global const float *p2,
                      extent e, site first, uint row) {
    const size_t offset = plane_offset(first, e);
    const site at = {first.x, first.y + row, first.odd};
    const image i = {p0 + offset, p1 + offset, p2 + offset, e.pitch, (int)row, at, 0};
    return i;
}

INLINE image ring_at(__global const float *p0, __global const float *p1, __global const float *p2,
                     extent e, site first, uint row) {
    const site at = {first.x, first.y + row, first.odd};
    const image i = {p0 + first.x, p1 + first.x, p2 + first.x, e.pitch, (int)row, at, e.ring};
    return i;
}

INLINE vf tap_plane(__global const float *plane, image i, int dx, int dy) {
    if (IN_RING(i)) return load(plane + ring_row((int)i.at.y + dy, i.ring) * (long)i.pitch + dx);
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

// The position of a pixel's mirror image along a side of n, or its own if it has none. Pixels have
// more than one if n <= 2 * border + 1; then a launch of `fill_border` follows the stores.
INLINE int mirror_image(int place, int n, int border) {
    return place <= border ? -place : place + border >= n - 1 ? 2 * (n - 1) - place : place;
}

// `x` and `y` start where the planes begin.
INLINE void store_at_edge(vf v, __global float *dst, int x, int y, extent e) {
    const int border = (int)e.border, columns = (int)e.columns;
    const int image_y = mirror_image(y, (int)e.rows, border);
    __global float *origin = IN_RING(e) ? dst : dst + (size_t)border * e.pitch + border_left(e);
    __global float *row = origin + (IN_RING(e) ? ring_row(y, e.ring) : (long)y) * (long)e.pitch;
    __global float *image_row =
        origin + (IN_RING(e) ? ring_row(image_y, e.ring) : (long)image_y) * (long)e.pitch;
    if (LANES > 1 && x > border && x + LANES + border < columns) {
        store(v, row + x);
        store(v, image_row + x);
        return;
    }
    float lanes[LANES];
    spill(v, lanes);
#pragma unroll 1
    for (int k = 0; k < LANES && x + k < columns; ++k) {
        const int image_column = mirror_image(x + k, columns, border);
        row[x + k] = row[image_column] = lanes[k];
        image_row[x + k] = image_row[image_column] = lanes[k];
    }
}

// The pixel that reflect-101 shows at a position of a side of n, or of the border around it.
INLINE int mirrored(int place, int n, int border) {
    const int period = n > 1 ? 2 * (n - 1) : 1, within = (place + border * period) % period;
    return within < n ? within : period - within;
}

// The pixel for a position of a side of n, or of the border around it: the nearest one in whole
// periods of a filter array. Without a period, or on a side that is shorter, it is the mirrored
// one.
INLINE int stand_in(int place, int n, int border, int period) {
    if (!period || n < period) return mirrored(place, n, border);
    if (place < 0) return place + (period - 1 - place) / period * period;
    return place < n ? place : place - ((place - n) / period + 1) * period;
}

// One position of a plane and its border; `column` and `row` start at the border's corner.
INLINE void fill_border(__global float *plane, uint column, uint row, int down, int across, extent e) {
    const int border = (int)e.border, columns = (int)e.columns;
    const int x = (int)column - border, y = (int)row - border;
    const int from_x = stand_in(x, columns, border, across), from_y = stand_in(y, (int)e.rows, border, down);
    __global float *origin = plane + (size_t)border * e.pitch + border_left(e);
    if (x < columns + border && (x != from_x || y != from_y))
        origin[(long)y * (long)e.pitch + x] = origin[(long)from_y * (long)e.pitch + from_x];
}

// Whether a block of rows has pixels that the border mirrors, or that are outside the image.
INLINE bool near_edge(site at, uint rows, extent e) {
    const uint x = at.x - e.left, y = at.y - e.top;
    return x <= e.border || x + LANES + e.border >= e.columns || y <= e.border ||
           y + rows + e.border >= e.rows;
}

// A pixel of a block that is not near an edge.
INLINE void store_plane_inside(vf v, __global float *dst, site at, extent e) {
    if (IN_RING(e)) store(v, dst + ring_row((int)at.y, e.ring) * (long)e.pitch + at.x);
    else store(v, dst + plane_offset(at, e));
}

// Any pixel, with its mirror images.
INLINE void store_plane(vf v, __global float *dst, site at, extent e) {
    const uint x = at.x - e.left, y = at.y - e.top;
    if (!near_edge(at, 1, e)) store_plane_inside(v, dst, at, e);
    else if (y < e.rows) store_at_edge(v, dst, (int)x, (int)y, e);
}

// store_rgb(v, plane0, plane1, plane2, at, e), store_rgb_inside(...) and so on for each kind.
#define STORES(STORE, suffix)                                                                     \
    INLINE void store_mosaic##suffix(vf v, __global float *p0, site at, extent e) {               \
        STORE(v, p0, at, e);                                                                      \
    }                                                                                             \
    INLINE void store_pair##suffix(pair v, __global float *p0, __global float *p1, site at,       \
                                   extent e) {                                                    \
        STORE(v.first, p0, at, e);                                                                \
        STORE(v.second, p1, at, e);                                                               \
    }                                                                                             \
    INLINE void store_rgb##suffix(rgb v, __global float *p0, __global float *p1,                  \
                                  __global float *p2, site at, extent e) {                        \
        STORE(v.r, p0, at, e);                                                                    \
        STORE(v.g, p1, at, e);                                                                    \
        STORE(v.b, p2, at, e);                                                                    \
    }                                                                                             \
    INLINE void store_ycbcr##suffix(ycbcr v, __global float *p0, __global float *p1,              \
                                    __global float *p2, site at, extent e) {                      \
        STORE(v.y, p0, at, e);                                                                    \
        STORE(v.cb, p1, at, e);                                                                   \
        STORE(v.cr, p2, at, e);                                                                   \
    }
STORES(store_plane, )
STORES(store_plane_inside, _inside)
#undef STORES

#endif
