// Parts that non-local means over 3x3 patches share. They work on blocks of 4 rows and COLUMNS
// vectors. Sums of three squared differences, one below the other, are stored
// once, and each patch adds three of them side by side. The first patch begins a pixel to the left of
// the block and the last one ends a pixel to its right, so there are more columns of sums than of
// pixels.
#ifndef CLPIPE_PATCH_H
#define CLPIPE_PATCH_H

#define WITH_MARGIN (LANES == 1 ? COLUMNS + 2 : COLUMNS + 1)

INLINE vf across(const float *down) { return unspill(down) + unspill(down + 1) + unspill(down + 2); }

// The last offset of the window. It is `reach`, but seems to depend on the work item: PoCL would
// otherwise turn the loops over the window inside out, a work-group in each turn, and everything
// that is summed up would go through memory.
INLINE int last_offset(site at, int reach) { return reach + (int)(at.x >> 31); }

#endif
