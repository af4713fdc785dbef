// Makes an image smaller: averages its rows, then its columns, with weights. The host computes the
// weights. Line i of the result is the weighted mean of `count` lines, starting at first[i].
//
// `r`, `g`, `b` point to the position of the input's first pixel in each plane. Rows and
// lanes outside an image or a tile are computed as well; their reads are clamped to it.
INLINE int clamped_start(int first, uint low, uint size, uint count) {
    const int last = (int)(low + size) - (int)count;
    return first < (int)low ? (int)low : first > last ? last : first;
}

INLINE rgb resize_rows(site at, __global const float *r, __global const float *g,
                       __global const float *b, extent from, __global const int *first,
                       __global const float *weights, uint count, uint stride) {
    const long start = clamped_start(first[at.y], from.top, from.rows, count);
    __global const float *row_weights = weights + (size_t)at.y * count;
    rgb sum = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    for (uint k = 0; k < count; ++k) {
        const vf weight = (vf)(row_weights[k]);
        const long place = (start + k) * (long)from.pitch + at.x;
        sum.r += weight * load(r + place);
        sum.g += weight * load(g + place);
        sum.b += weight * load(b + place);
    }
    return sum;
}

INLINE vf gather(__global const float *row, const int *start, uint k) {
    float lanes[LANES];
#pragma unroll
    for (int lane = 0; lane < LANES; ++lane) lanes[lane] = row[start[lane] + (int)k];
    return unspill(lanes);
}

INLINE rgb resize_columns(site at, __global const float *r, __global const float *g,
                          __global const float *b, extent from, __global const int *first,
                          __global const float *weights, uint count, uint stride) {
    const long row = (long)at.y * (long)from.pitch;
    int start[LANES];
#pragma unroll
    for (int lane = 0; lane < LANES; ++lane)
        start[lane] = clamped_start(first[at.x + lane], from.left, from.columns, count);
    rgb sum = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
    for (uint k = 0; k < count; ++k) {
        const vf weight = load(weights + (size_t)k * stride + at.x);
        sum.r += weight * gather(r + row, start, k);
        sum.g += weight * gather(g + row, start, k);
        sum.b += weight * gather(b + row, start, k);
    }
    return sum;
}
