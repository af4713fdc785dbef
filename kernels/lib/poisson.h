// Poisson numbers by inverse CDF from one random word, with a fixed amount of work (after Giles,
// "Algorithm 955: Approximation of the inverse Poisson cumulative distribution function", ACM TOMS
// 42(1), 2016). Only *, +, comparisons and bit operations, so NumPy gives the same bits.
#ifndef CLPIPE_POISSON_H
#define CLPIPE_POISSON_H

#define POISSON_LARGE 10.0f  // mean from which the expansion is used
#define POISSON_TERMS 36     // a Poisson number of mean 10 exceeds this with a probability of 1e-10

__constant float POISSON_INVERSES[POISSON_TERMS + 1] = {
    0.0f,         1.0f,         1.0f / 2.0f,  1.0f / 3.0f,  1.0f / 4.0f,  1.0f / 5.0f,
    1.0f / 6.0f,  1.0f / 7.0f,  1.0f / 8.0f,  1.0f / 9.0f,  1.0f / 10.0f, 1.0f / 11.0f,
    1.0f / 12.0f, 1.0f / 13.0f, 1.0f / 14.0f, 1.0f / 15.0f, 1.0f / 16.0f, 1.0f / 17.0f,
    1.0f / 18.0f, 1.0f / 19.0f, 1.0f / 20.0f, 1.0f / 21.0f, 1.0f / 22.0f, 1.0f / 23.0f,
    1.0f / 24.0f, 1.0f / 25.0f, 1.0f / 26.0f, 1.0f / 27.0f, 1.0f / 28.0f, 1.0f / 29.0f,
    1.0f / 30.0f, 1.0f / 31.0f, 1.0f / 32.0f, 1.0f / 33.0f, 1.0f / 34.0f, 1.0f / 35.0f,
    1.0f / 36.0f};

// For a mean below POISSON_LARGE. The number is the count of k with a CDF below u. For u above 1/2,
// it is the count of k with P(X >= k) above 1 - u. Both sums begin with their smallest terms, which
// keeps the tails exact.
INLINE vf poisson_small(vf mean, vu word) {
    const vf p = tail_probability(word);
    vf terms[POISSON_TERMS + 1];
    vf cdf = exponential(-mean), lower = (vf)(0.0f);
    terms[0] = cdf;
#pragma unroll
    for (int k = 1; k <= POISSON_TERMS; ++k) {
        terms[k] = terms[k - 1] * (mean * POISSON_INVERSES[k]);
        if (k <= 11) {  // half of all numbers of mean 10 are not above 10
            lower = cdf < p ? lower + 1.0f : lower;
            cdf = cdf + terms[k];
        }
    }
    vf rest = (vf)(0.0f), upper = (vf)(0.0f);
#pragma unroll
    for (int k = POISSON_TERMS; k >= 1; --k) {
        rest = rest + terms[k];
        upper = rest > p ? upper + 1.0f : upper;
    }
    return in_upper_half(word) ? upper : lower;
}

// For a mean from POISSON_LARGE on: the integer part of the continuous quantile mean + sqrt(mean) w
// + w^2 A(s) + B(s) + C(s) / mean. w is the normal quantile and s = w / sqrt(mean), the form of
// Temme's expansion. A, B and C are our own weighted least-squares fits. The error is 3e-4 within 3
// sigma and 4e-3 within 5. The mean's integer part is added last, so that large means lose no
// digits.
INLINE vf poisson_large(vf mean, vu word) {
    const vf w = normal_of(word);
    const vf r = inverse_root(mean);
    const vf s = vmax(w * r, (vf)(-1.3f));  // below that, the number is 0 anyway
    const vf s2 = s * s, s4 = s2 * s2;
    const vf a0 = (s * -0.01394692063331604f + 0.16666667f) +
                  (s * -0.001212189788930118f + 0.003954051993787289f) * s2;
    const vf a4 = (s * -0.0003447002964094281f + 0.00014181389997247607f) +
                  (s * -0.00013785895134788007f + 0.0004576310748234391f) * s2;
    const vf b0 = (s * -0.027716415002942085f + 0.33333334f) +
                  (s * -0.002561307279393077f + 0.007524685002863407f) * s2;
    const vf b = b0 + s4 * -0.00019453179265838116f;
    const vf c = s * 0.016855543479323387f + -0.0197614673525095f;
    const vf whole = mean < 4194304.0f ? nearest(mean) : mean;
    const vf offset = (mean * r) * w + ((w * w) * (a0 + a4 * s4) + (b + c * (r * r)));
    const vf v = offset + (mean - whole);
    const vf rounded = nearest(v);
    return vmax(whole + (rounded > v ? rounded - 1.0f : rounded), (vf)(0.0f));
}

// The Poisson number of a mean >= 0 for a random word.
INLINE vf poisson_of(vf mean, vu word) {
    const vf large = poisson_large(vmax(mean, (vf)(POISSON_LARGE)), word);
    if (!any_lane(mean < POISSON_LARGE)) return large;
    const vf small = poisson_small(vmin(mean, (vf)(POISSON_LARGE)), word);
    return mean < POISSON_LARGE ? small : large;
}

#endif
