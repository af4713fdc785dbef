// The colour filter array: which of the four sites of a 2x2 Bayer cell a lane stands on.
#ifndef CLPIPE_CFA_H
#define CLPIPE_CFA_H

// Where red stands in the cell; blue is diagonally across, green fills the rest (Bayer 1976).
typedef struct { uint red_x, red_y; } cfa;

INLINE bool in_red_row(site at, cfa pattern) { return ((at.y ^ pattern.red_y) & 1) == 0; }
INLINE vi in_red_column(site at, cfa pattern) { return pattern.red_x ? at.odd : ~at.odd; }

// Of three values, one for each colour, the one for the colour of the site.
INLINE vf by_site(site at, cfa pattern, vf red, vf green, vf blue) {
    const vi red_column = in_red_column(at, pattern);
    return in_red_row(at, pattern) ? (red_column ? red : green) : (red_column ? green : blue);
}

#endif
