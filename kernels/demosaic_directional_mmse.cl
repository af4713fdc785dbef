// Demosaicing for any filter array by linear 7x7 filters under eight image models, each weighted by
// how well it predicts the surrounding samples.
#include "lib/table.h"

#define MODELS 8

// The squared errors of two models at a sample.
INLINE pair errors_from(site at, src_image src, __global const float *misses, uint rows, uint columns, uint first) {
#pragma OPENCL FP_CONTRACT ON
    const uint next = columns + TABLE_LANES;
    __global const float *entry = table_at(at, misses, rows, columns, 7 * 7 * MODELS) + first * next;
    vf one = (vf)(0.0f), two = (vf)(0.0f);
    UNROLL_ROWS
    for (int dy = -3; dy <= 3; ++dy) {
        for (int dx = -3; dx <= 3; ++dx) {
            const vf sample = src_tap(src, dx, dy);
            one += load(entry) * sample;
            two += load(entry + next) * sample;
            entry += MODELS * next;
        }
    }
    const pair v = {one * one, two * two};
    return v;
}

INLINE pair errors_0(site at, src_image src, __global const float *misses, uint rows, uint columns) {
    return errors_from(at, src, misses, rows, columns, 0);
}

INLINE pair errors_2(site at, src_image src, __global const float *misses, uint rows, uint columns) {
    return errors_from(at, src, misses, rows, columns, 2);
}

INLINE pair errors_4(site at, src_image src, __global const float *misses, uint rows, uint columns) {
    return errors_from(at, src, misses, rows, columns, 4);
}

INLINE pair errors_6(site at, src_image src, __global const float *misses, uint rows, uint columns) {
    return errors_from(at, src, misses, rows, columns, 6);
}

// The mean error over 5x5 pixels, plus `unseen`, the error of the colours that were not sampled.
INLINE pair mean_errors(image errors, float unseen) {
    pair sum = {(vf)(0.0f), (vf)(0.0f)};
    UNROLL_ROWS
    for (int dy = -2; dy <= 2; ++dy) {
        for (int dx = -2; dx <= 2; ++dx) {
            const pair e = tap_pair(errors, dx, dy);
            sum.first += e.first;
            sum.second += e.second;
        }
    }
    const pair v = {sum.first * 0.04f + unseen, sum.second * 0.04f + unseen};
    return v;
}

INLINE vf fourth_power(vf v) { return (v * v) * (v * v); }

INLINE pair model_weights(pair error, vf least) {
    const pair v = {fourth_power(least / error.first), fourth_power(least / error.second)};
    return v;
}

// A filter weight, summed over two models with the weights of the models.
INLINE vf weight_of(__global const float *entry, uint next, pair count) {
#pragma OPENCL FP_CONTRACT ON
    return load(entry) * count.first + load(entry + 3 * next) * count.second;
}

INLINE rgb blend(site at, src_image src, image errors_0, image errors_2, image errors_4, image errors_6,
                 __global const float *colours, uint rows, uint columns, float unseen) {
#pragma OPENCL FP_CONTRACT ON
    const pair e0 = mean_errors(errors_0, unseen), e2 = mean_errors(errors_2, unseen);
    const pair e4 = mean_errors(errors_4, unseen), e6 = mean_errors(errors_6, unseen);
    const vf least = vmin(vmin(vmin(e0.first, e0.second), vmin(e2.first, e2.second)),
                          vmin(vmin(e4.first, e4.second), vmin(e6.first, e6.second)));
    const pair t0 = model_weights(e0, least), t2 = model_weights(e2, least), t4 = model_weights(e4, least), t6 = model_weights(e6, least);
    const uint next = columns + TABLE_LANES;
    __global const float *entry = table_at(at, colours, rows, columns, 7 * 7 * MODELS * 3);
    rgb v = {(vf)(0.0f), (vf)(0.0f), (vf)(0.0f)};
#pragma unroll 1  // unrolled, it is no faster, and takes four times as long to compile
    for (int dy = -3; dy <= 3; ++dy) {
        for (int dx = -3; dx <= 3; ++dx) {
            const vf sample = src_tap(src, dx, dy);
            vf weights[3];
            for (uint c = 0; c < 3; ++c) {
                __global const float *of = entry + c * next;
                weights[c] = (weight_of(of, next, t0) + weight_of(of + 6 * next, next, t2)) +
                             (weight_of(of + 12 * next, next, t4) + weight_of(of + 18 * next, next, t6));
            }
            v.r += weights[0] * sample;
            v.g += weights[1] * sample;
            v.b += weights[2] * sample;
            entry += MODELS * 3 * next;
        }
    }
    const vf all = ((t0.first + t0.second) + (t2.first + t2.second)) + ((t4.first + t4.second) + (t6.first + t6.second));
    const vf share = 1.0f / all;
    v.r *= share;
    v.g *= share;
    v.b *= share;
    return v;
}
