// Binning: averages the rows, then the columns, of each cell of the larger mosaic.
#include "resize.cl"

INLINE vf bin_rows(site at, __global const float *r, __global const float *g, __global const float *b,
                   extent from, __global const int *first, __global const float *weights, uint count, uint stride) {
    return resize_rows(at, r, r, r, from, first, weights, count, stride).r;
}

INLINE vf bin_columns(site at, __global const float *r, __global const float *g, __global const float *b,
                      extent from, __global const int *first, __global const float *weights, uint count, uint stride) {
    return resize_columns(at, r, r, r, from, first, weights, count, stride).r;
}
