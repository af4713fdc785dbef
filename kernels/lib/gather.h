// A channel of an image at positions between its pixels, with a filter. Rows and lanes outside an
// image or a tile are gathered as well; their reads are clamped to it.
#ifndef CLPIPE_GATHER_H
#define CLPIPE_GATHER_H

// The weights of the taps at a fraction between two pixels; each is a polynomial of it.
INLINE void weights_of(vf fraction, __global const float *filter, int taps, int powers, vf *weights) {
#pragma unroll
    for (int tap = 0; tap < taps; ++tap) {
        vf weight = (vf)(filter[tap * powers + powers - 1]);
#pragma unroll
        for (int power = powers - 2; power >= 0; --power)
            weight = weight * fraction + filter[tap * powers + power];
        weights[tap] = weight;
    }
}

// The pixel before a position, counted from `line` on, and the remaining fraction.
INLINE vi split(vf way, vi line, vf *fraction) {
    const vi cut = to_int(way);
    const vi whole = to_float(cut) > way ? cut - 1 : cut;
    *fraction = way - to_float(whole);
    return line + whole;
}

// Whether a position is within the image, up to the edges of its pixels.
INLINE vi is_inside(vi pixel, vf fraction, int size) {
    const vi low = (pixel >= 0) | ((pixel == -1) & (fraction >= 0.5f));
    return low & ((pixel < size - 1) | ((pixel == size - 1) & (fraction <= 0.5f)));
}

INLINE vi moved_into(vi pixel, uint first, uint count) {
    return vmin_int(vmax_int(pixel, (vi)((int)first - 1)), (vi)((int)(first + count) - 1));
}

#if LANES > 1
#define FARTHEST 4  // px between the first and the last tap of lanes that load together
#if LANES == 8
#define FOLD(f, v) const int4 v##q = f(v.lo, v.hi);
#else
#define FOLD(f, v) const int8 v##h = f(v.lo, v.hi); const int4 v##q = f(v##h.lo, v##h.hi);
#endif
#define LESS(a, b) ((a) < (b) ? (a) : (b))
#define MORE(a, b) ((a) > (b) ? (a) : (b))
INLINE int least_lane(vi v) {
    FOLD(LESS, v)
    return LESS(LESS(vq.x, vq.y), LESS(vq.z, vq.w));
}
INLINE int greatest_lane(vi v) {
    FOLD(MORE, v)
    return MORE(MORE(vq.x, vq.y), MORE(vq.z, vq.w));
}

// The sum over a window that is one pixel wider and higher than the filter. The taps of each lane
// begin 0 or 1 after its corner, and all others have the weight 0, which does not change a sum.
INLINE vf near_sum(__global const float *corner, uint pitch, vi column, vi row, const vf *of_column,
                   const vf *of_row, int taps) {
    const vf none = (vf)(0.0f);
    const vi right = column == 1, below = row == 1;
    vf columns[7], total = none;
#pragma unroll
    for (int k = 0; k <= taps; ++k)
        columns[k] = right ? (k > 0 ? of_column[k - 1] : none) : (k < taps ? of_column[k] : none);
#pragma unroll
    for (int j = 0; j <= taps; ++j) {
        vf sum = none;
#pragma unroll
        for (int k = 0; k <= taps; ++k) sum += columns[k] * load(corner + k);
        total += (below ? (j > 0 ? of_row[j - 1] : none) : (j < taps ? of_row[j] : none)) * sum;
        corner += pitch;
    }
    return total;
}

// The weight, at a position in the window, of lanes whose taps begin `start` after its corner.
INLINE vf weight_at(int place, vi start, const vf *weights, int taps) {
    vf weight = (vf)(0.0f);
#pragma unroll
    for (int tap = 0; tap < taps; ++tap) weight = start == place - tap ? weights[tap] : weight;
    return weight;
}

// The sum over a window that is larger than the filter by `wide` and `high`.
INLINE vf window_sum(__global const float *corner, uint pitch, vi column, vi row, const vf *of_column,
                     const vf *of_row, int taps, int wide, int high) {
    vf columns[6 + FARTHEST], total = (vf)(0.0f);
#pragma unroll 1
    for (int k = 0; k < taps + wide; ++k) columns[k] = weight_at(k, column, of_column, taps);
#pragma unroll 1
    for (int j = 0; j < taps + high; ++j) {
        vf sum = (vf)(0.0f);
#pragma unroll 1
        for (int k = 0; k < taps + wide; ++k) sum += columns[k] * load(corner + k);
        total += weight_at(j, row, of_row, taps) * sum;
        corner += pitch;
    }
    return total;
}
#endif

INLINE vf gather(__global const float *row, const int *start, int tap) {
    float lanes[LANES];
#pragma unroll
    for (int lane = 0; lane < LANES; ++lane) lanes[lane] = row[start[lane] + tap];
    return unspill(lanes);
}

// One channel at an offset from each pixel; 0 outside the input.
INLINE vf sample_at_offset(site at, __global const float *plane, extent from, vf across, vf down,
               __global const float *filter, int taps, int powers) {
    vf u, v;
    const vi own = iota() + (vi)((int)at.x);
    vi column = split(across, own, &u), row = split(down, (vi)((int)at.y), &v);
    const vi inside = is_inside(column, u, (int)from.width) & is_inside(row, v, (int)from.height);
    vf total = (vf)(0.0f);
    if (!any_lane(inside)) return total;
    column = moved_into(column, from.left, from.columns) - (taps / 2 - 1) - own;
    row = moved_into(row, from.top, from.rows) - (taps / 2 - 1);
    vf of_column[8], of_row[8];
    weights_of(u, filter, taps, powers, of_column);
    weights_of(v, filter, taps, powers, of_row);
#if LANES > 1
    // Adjacent lanes show pixels that are nearly adjacent. All of them are loaded together, and
    // those that do not belong to a lane have the weight 0, which does not change its sum.
    const int left = least_lane(column), top = least_lane(row);
    const int wide = greatest_lane(column) - left, high = greatest_lane(row) - top;
    const int border = (int)from.border, first = (int)at.x + left;
    if (wide <= FARTHEST && high <= FARTHEST && first >= (int)from.left - border &&
        first + LANES + taps + wide <= (int)(from.left + from.columns) + border &&
        top + taps + high < (int)(from.top + from.rows) + border) {
        __global const float *corner = plane + (long)top * (long)from.pitch + first;
        column -= left;
        row -= top;
        total = wide <= 1 && high <= 1
                    ? near_sum(corner, from.pitch, column, row, of_column, of_row, taps)
                    : window_sum(corner, from.pitch, column, row, of_column, of_row, taps, wide, high);
        return inside ? total : (vf)(0.0f);
    }
#endif
    int start[LANES];
    spill_int(row * (vi)((int)from.pitch) + column + own, start);
#pragma unroll 1
    for (int j = 0; j < taps; ++j) {
        vf sum = (vf)(0.0f), of_this_row = of_row[0];
#pragma unroll
        for (int k = 0; k < taps; ++k) sum += of_column[k] * gather(plane, start, k);
#pragma unroll
        for (int k = 1; k < taps; ++k) of_this_row = j == k ? of_row[k] : of_this_row;
        total += of_this_row * sum;
        plane += from.pitch;
    }
    return inside ? total : (vf)(0.0f);
}

#endif
