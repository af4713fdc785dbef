// Tables of a filter array: a row for each row of its period, which goes on behind its last column, so that a
// vector of lanes is loaded from any column on.
#ifndef CLPIPE_TABLE_H
#define CLPIPE_TABLE_H

#define TABLE_LANES 16

// The place of a pixel's first value; `each` is how many values a place has, row behind row.
INLINE __global const float *table_at(site at, __global const float *table, uint rows, uint columns, uint each) {
    return table + (at.y % rows) * each * (columns + TABLE_LANES) + at.x % columns;
}

#endif
