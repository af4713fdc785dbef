// Sums over an image in integers: exact, so order, lanes, tiles and devices do not matter. A block
// writes one int4 of partial sums, one for each site of the 2x2 cell of a mosaic: (even x, even y),
// (odd x, even y), (even x, odd y), (odd x, odd y).
#ifndef CLPIPE_SUMS_H
#define CLPIPE_SUMS_H

// A tile's core begins with a whole block.
INLINE vi only_inside(vi v, site at, core c) {
    if (at.y < c.top || at.y >= c.bottom || at.x < c.left) return (vi)(0);
    return (iota() + (vi)((int)at.x)) < (vi)((int)c.right) ? v : (vi)(0);
}

INLINE int2 fold_columns(vi v, site at) {
#if LANES == 1
    return at.odd ? (int2)(0, v) : (int2)(v, 0);
#elif LANES == 8
    const int4 half_way = v.lo + v.hi;
    return half_way.lo + half_way.hi;
#else
    const int8 half_way = v.lo + v.hi;
    const int4 quarter = half_way.lo + half_way.hi;
    return quarter.lo + quarter.hi;
#endif
}

#if LANES == 1
// Sums within a work-group, a power of two of work items, because on a GPU they would take long to
// add up one by one.
INLINE void store_group_sums(int4 own, __local int4 *group, __global int4 *sums) {
    const uint i = get_local_id(0);
    group[i] = own;
    for (uint n = get_local_size(0) / 2; n > 0; n /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (i < n) group[i] += group[i + n];
    }
    if (i == 0) sums[get_group_id(1) * get_num_groups(0) + get_group_id(0)] = group[0];
}
#else
INLINE void store_sums(int4 own, __global int4 *sums, site first, extent e) {
    const uint across = (e.columns + LANES - 1) / LANES;
    sums[(size_t)((first.y - e.top) / 4) * across + (first.x - e.left) / LANES] = own;
}
#endif

// Work item i of n adds its share of the blocks to the sums of earlier tiles.
INLINE void add_up_blocks(__global const int4 *blocks, __global long4 *partials, uint count,
                          uint tile) {
    const uint n = get_global_size(0), i = get_global_id(0);
    long4 sum = tile ? partials[i] : (long4)(0);
    for (uint k = i; k < count; k += n) {
        const int4 block = blocks[k];  // not convert_long4, for the same reason as in load_half
        sum += (long4)(block.x, block.y, block.z, block.w);
    }
    partials[i] = sum;
}

INLINE long4 add_up_partials(__global const long4 *partials, uint count) {
    long4 sum = (long4)(0);
    for (uint k = 0; k < count; ++k) sum += partials[k];
    return sum;
}

// Adds partial histograms to that of earlier tiles. After its bins follow the sums of each RUN of
// them, with which a percentile is found in few steps.
#if LANES == 1
INLINE void add_up_counts(__global const uint *counts, __global uint *histogram, uint bins,
                          uint partials, uint tile, __local uint *group) {
    const uint bin = get_global_id(0), i = get_local_id(0);
    uint sum = 0;
    if (bin < bins) {
        if (tile) sum = histogram[bin];
        for (uint k = 0; k < partials; ++k) sum += counts[(size_t)k * bins + bin];
        histogram[bin] = sum;
    }
    group[i] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (bin >= bins || i % RUN) return;
    for (uint k = 1; k < RUN; ++k) sum += group[i + k];
    histogram[bins + bin / RUN] = sum;
}
#else
INLINE void add_up_counts(__global const uint *counts, __global uint *histogram, uint bins,
                          uint partials, uint tile) {
    for (uint run = get_global_id(0); run * RUN < bins; run += get_global_size(0)) {
        uint total = 0;
        for (uint bin = run * RUN; bin < bins && bin < (run + 1) * RUN; ++bin) {
            uint sum = tile ? histogram[bin] : 0;
            for (uint k = 0; k < partials; ++k) sum += counts[(size_t)k * bins + bin];
            histogram[bin] = sum;
            total += sum;
        }
        histogram[bins + run] = total;
    }
}
#endif

#endif
