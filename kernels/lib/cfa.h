// The colour filter array: the site of each lane in the 2x2 Bayer cell.
#ifndef CLPIPE_CFA_H
#define CLPIPE_CFA_H

// Position of red in the cell; blue is diagonally opposite, and green fills the rest (Bayer 1976).
typedef struct { uint red_x, red_y; } cfa;

INLINE bool in_red_row(site at, cfa pattern) { return ((at.y ^ pattern.red_y) & 1) == 0; }
INLINE vi in_red_column(site at, cfa pattern) { return pattern.red_x ? at.odd : ~at.odd; }

// Returns the one of three values, one per colour, that belongs to the site's colour.
INLINE vf by_site(site at, cfa pattern, vf red, vf green, vf blue) {
    const vi red_column = in_red_column(at, pattern);
    return in_red_row(at, pattern) ? (red_column ? red : green) : (red_column ? green : blue);
}

#endif
