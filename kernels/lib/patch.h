// Functions that non-local means over 3x3 patches share. They work on blocks of 4 rows and COLUMNS
// vectors. Vertical sums of three squared differences are stored once, and each patch adds three
// adjacent ones. The first patch begins a pixel to the left of the block and the last one ends a
// pixel to its right, so there are more columns of sums than of pixels.
#ifndef CLPIPE_PATCH_H
#define CLPIPE_PATCH_H

#define WITH_MARGIN (LANES == 1 ? COLUMNS + 2 : COLUMNS + 1)

INLINE vf across(const float *down) { return unspill(down) + unspill(down + 1) + unspill(down + 2); }

// The last offset of the window. It is `reach`, but seems to depend on the work item. Otherwise
// PoCL would make the loops over the window the outer ones, with a work-group in each iteration,
// and all sums would go through memory.
INLINE int last_offset(site at, int reach) { return reach + (int)(at.x >> 31); }

#endif
