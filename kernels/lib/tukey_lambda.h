// The symmetric Tukey lambda distribution, a model of read noise with heavy tails (Wei et al., "A
// physics-based noise formation model for extreme low-light raw denoising", CVPR 2020).
#ifndef CLPIPE_TUKEY_LAMBDA_H
#define CLPIPE_TUKEY_LAMBDA_H

// (q^lambda - p^lambda) / lambda, scaled to variance 1, for the tail probability p and q = 1 - p.
// Only *, + and bit operations, so NumPy gives the same bits.
INLINE vf tukey_lambda_of(vu word, float shape, float scale) {
    const vf p = tail_probability(word);
    const vf low = exponential_minus_1(negative_log(p) * -shape);
    const vf high = exponential_minus_1(negative_log(1.0f - p) * -shape);
    const vf z = (high - low) * scale;
    return in_upper_half(word) ? z : -z;
}

#endif
