// Medians of the 3x3 and 5x5 pixels around a pixel, in one plane.
//
// Both first sort the rows of the window. A sorted row is the same for every window that contains
// it. The rows that the windows of lines 2n and 2n+1 share are sorted first, in the same order in
// both. The compiler therefore computes them once for a work item, which processes both lines. It
// also drops the halves of exchanges that are not used.
#ifndef CLPIPE_MEDIAN_H
#define CLPIPE_MEDIAN_H

#define ORDER(a, b) { const vf smaller = vmin(a, b); b = vmax(a, b); a = smaller; }

// Sorts three values in ascending order.
typedef struct { vf a, b, c; } sorted3;
typedef struct { vf a, b, c, d, e; } sorted5;

INLINE sorted3 sort3(vf a, vf b, vf c) {
    ORDER(b, c) ORDER(a, b) ORDER(b, c)
    const sorted3 s = {a, b, c};
    return s;
}

// Nine exchanges, the minimum (Knuth, The Art of Computer Programming 3, 5.3.4).
INLINE sorted5 sort5(vf a, vf b, vf c, vf d, vf e) {
    ORDER(a, d) ORDER(b, e)
    ORDER(a, c) ORDER(b, d)
    ORDER(a, b) ORDER(c, e)
    ORDER(b, c) ORDER(d, e)
    ORDER(c, d)
    const sorted5 s = {a, b, c, d, e};
    return s;
}

// Sorts four values, then inserts the fifth.
INLINE sorted5 sort4_and_insert(vf a, vf b, vf c, vf d, vf x) {
    ORDER(a, b) ORDER(c, d)
    ORDER(a, c) ORDER(b, d)
    ORDER(b, c)
    const sorted5 s = {vmin(a, x), vmax(a, vmin(b, x)), vmax(b, vmin(c, x)),
                       vmax(c, vmin(d, x)), vmax(d, x)};
    return s;
}

INLINE vf median3(vf a, vf b, vf c) { return vmax(vmin(a, b), vmin(vmax(a, b), c)); }

// The median of three sorted rows, in any order: the median of the largest of their first values, the
// median of their middle values and the smallest of their last values (Smith 1996).
INLINE vf median9(sorted3 p, sorted3 q, sorted3 r) {
    return median3(vmax(vmax(p.a, q.a), r.a), median3(p.b, q.b, r.b),
                   vmin(vmin(p.c, q.c), r.c));
}

// The median of five sorted rows, in any order. With columns sorted as well, 12 of the 25 values
// cannot be the median. The value in row i and column j has i*j - 1 values that are not larger and
// (6-i)*(6-j) - 1 that are not smaller. Among the other 13, the search below drops those that must
// be on one side. It is right for all 252 ways in which zeros and ones can be sorted by rows and
// columns, and so for all values (Knuth's zero-one principle).
INLINE vf median25(sorted5 p, sorted5 q, sorted5 r, sorted5 s, sorted5 t) {
    const sorted5 column1 = sort4_and_insert(p.a, q.a, r.a, s.a, t.a);
    const sorted5 column2 = sort4_and_insert(p.b, q.b, r.b, s.b, t.b);
    const sorted5 column3 = sort4_and_insert(p.c, q.c, r.c, s.c, t.c);
    const sorted5 column4 = sort4_and_insert(p.d, q.d, r.d, s.d, t.d);
    const sorted5 column5 = sort4_and_insert(p.e, q.e, r.e, s.e, t.e);
    const vf m = vmin(vmax(column3.b, column2.d), column4.c);
    vf a = vmin(vmax(column4.b, column1.d), column2.e);
    vf b = vmin(column5.b, m);
    b = vmax(b, column4.a);
    vf c = vmin(vmax(column5.a, column2.c), column3.d);
    vf d = column1.e;
    ORDER(c, d)
    ORDER(b, a)
    a = vmin(a, d);
    c = vmax(b, c);
    vf e = column3.c;
    ORDER(c, e)
    return vmin(e, vmax(c, a));
}
#undef ORDER

// The median of the 3x3 or 5x5 pixels around those at `i`, whose samples are in `plane`.
INLINE vf median_3x3(__global const float *plane, image i) {
#define ROW(dy) sort3(TAP(dy, -1), TAP(dy, 0), TAP(dy, 1))
#define TAP(dy, dx) tap_plane(plane, i, dx, dy)
    const int odd = i.at.y & 1;
    return median9(ROW(-odd), ROW(1 - odd), ROW(2 * odd - 1));
#undef ROW
}

INLINE vf median_5x5(__global const float *plane, image i) {
#define ROW(dy) sort5(TAP(dy, -2), TAP(dy, -1), TAP(dy, 0), TAP(dy, 1), TAP(dy, 2))
    const int odd = i.at.y & 1;
    return median25(ROW(-1 - odd), ROW(-odd), ROW(1 - odd), ROW(2 - odd), ROW(4 * odd - 2));
#undef TAP
#undef ROW
}

// `size` is 3 or 5, and a constant.
INLINE vf median_around(__global const float *plane, image i, int size) {
    return size == 5 ? median_5x5(plane, i) : median_3x3(plane, i);
}

#endif
