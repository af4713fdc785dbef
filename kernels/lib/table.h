// Tables of a filter array: a row for each row of its period, continued after its last column, so
// that a vector of lanes can be loaded from any column on.
#ifndef CLPIPE_TABLE_H
#define CLPIPE_TABLE_H

#define TABLE_LANES 16

// The index of a pixel's first value; `each` is the number of values at a position, as consecutive
// rows.
INLINE __global const float *table_at(site at, __global const float *table, uint rows, uint columns, uint each) {
    return table + (at.y % rows) * each * (columns + TABLE_LANES) + at.x % columns;
}

#endif
