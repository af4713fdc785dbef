// Short polynomials instead of the built-in log and exp, which are scalar calls on some CPU
// runtimes and differ between devices. The coefficients are our own least-squares minimax fits.
#ifndef CLPIPE_MATH_H
#define CLPIPE_MATH_H

// -ln(t) for t > 0; error 4e-7, relative if |ln(t)| is above 1, else absolute. Only * and +, so
// NumPy gives the same bits. Polynomials are summed in pairs (Estrin) and not one power after the
// other, because the latency of dependent sums dominates the time.
INLINE vf negative_log(vf t) {
    const vi bits = float_bits(t);
    const vi exponent = (bits - 0x3f3504f3) >> 23;  // mantissa in [sqrt(1/2), sqrt(2))
    const vf y = bits_to_float(bits - (exponent << 23)) - 1.0f;
    const vf y2 = y * y, y4 = y2 * y2;
    const vf low = (y * -0.50001967f + 1.0000032f) + (y * -0.24881342f + 0.33303297f) * y2;
    const vf p = low + ((y * -0.18901953f + 0.20604694f) + y2 * 0.118273675f) * y4;
    return to_float(exponent) * -0.6931472f - y * p;
}

// 1/sqrt(x) for x > 0; relative error 5e-6. Two Newton steps from the exponent halved by a shift
// (Lomont, "Fast inverse square root", 2003). The built-in function is not exact on all devices.
INLINE vf inverse_root(vf x) {
    const vf half_x = x * 0.5f;
    vf r = bits_to_float((vi)(0x5f375a86) - (float_bits(x) >> 1));
    r = r * (1.5f - half_x * r * r);
    return r * (1.5f - half_x * r * r);
}

// sqrt(x) for x >= 0; relative error 5e-6.
INLINE vf square_root(vf x) { return x * inverse_root(x); }

// 2^x = s * (1 + e) for |x| < 126: s is an integer power of two, e is accurate near x = 0. Only *
// and +.
INLINE vf power_of_two(vf x, __private vf *e) {
    const vf whole = nearest(x);
    const vf f = x - whole;
    const vf f2 = f * f;
    const vf low = (f * 0.24022651f + 0.69314719f) + (f * 0.0096180567f + 0.055503571f) * f2;
    *e = f * (low + (f * 0.00015461448f + 0.0013390867f) * (f2 * f2));
    return bits_to_float((to_int(whole) + 127) << 23);
}

// e^x and e^x - 1 for |x| < 87; relative error 1e-6 for |x| < 20, otherwise 4e-6, and for the
// latter also near 0.
INLINE vf exponential(vf x) {
    vf e;
    const vf s = power_of_two(x * 1.442695f, &e);
    return s + s * e;
}

INLINE vf exponential_minus_1(vf x) {
    vf e;
    const vf s = power_of_two(x * 1.442695f, &e);
    return s * e + (s - 1.0f);
}

// 2^x for x <= 0, at least 2^-30; relative error 8e-5. Smaller filter weights do not matter, and
// denormals are slow.
INLINE vf exp2_of_negative(vf x) {
#pragma OPENCL FP_CONTRACT ON
#if LANES == 1
    return native_exp2(vmax(x, -30.0f));  // one instruction of a GPU
#else
    const vf round_magic = (vf)(12582912.0f);  // 1.5 * 2^23: adding it rounds to an integer
    x = vmax(x, (vf)(-30.0f));
    const vf shifted = x + round_magic;
    const vf f = x - (shifted - round_magic);
    vf p = f * 0.055171624f + 0.24261113f;
    p = p * f + 0.69326097f;
    p = p * f + 0.99992806f;
    return bits_to_float(float_bits(p) + (float_bits(shifted) << 23));
#endif
}

#endif
