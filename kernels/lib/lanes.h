// Lane vectors: every stage is written once with vf / vi / vu, LANES of them wide. A CPU uses 8 or
// 16 lanes (one vector register), a GPU uses 1 (a plain scalar).
#ifndef CLPIPE_LANES_H
#define CLPIPE_LANES_H

// The same arithmetic on every device: never contract a*b+c implicitly.
#pragma OPENCL FP_CONTRACT OFF

#define INLINE static inline __attribute__((always_inline))

#if LANES == 1
typedef float vf;
typedef int vi;
typedef uint vu;
typedef ulong vh;
#define LANES_OF(name) name
#else
#define LANES_JOIN_(name, n) name##n
#define LANES_JOIN(name, n) LANES_JOIN_(name, n)
#define LANES_OF(name) LANES_JOIN(name, LANES)
typedef LANES_OF(float) vf;
typedef LANES_OF(int) vi;
typedef LANES_OF(uint) vu;
// Half as many lanes of 64 bits, the width of a vector register. PoCL 3.0 miscompiles wider ones.
#if LANES == 8
typedef ulong4 vh;
#else
typedef ulong8 vh;
#endif
#endif

// Before a loop over the rows of a window, which a GPU executes one by one. All rows at once take
// so many registers that only a few work items can run.
#if LANES == 1
#define UNROLL_ROWS _Pragma("unroll 1")
#else
#define UNROLL_ROWS _Pragma("unroll")
#endif

// Loads, stores, conversions, minimum and maximum are written without the OpenCL built-ins. On a
// CPU that PoCL 3.0 does not know, it does not inline them, and the calls cost a factor of ten.
#if LANES == 1
INLINE vf load(__global const float *p) { return *p; }
INLINE void store(vf v, __global float *p) { *p = v; }
INLINE vf load_half(__global const half *p) { return vload_half(0, p); }
INLINE vi iota(void) { return 0; }
INLINE void spill(vf v, __private float *p) { *p = v; }
INLINE vf unspill(__private const float *p) { return *p; }
INLINE void spill_int(vi v, __private int *p) { *p = v; }
INLINE vf to_float(vi v) { return convert_float(v); }
INLINE vi to_int(vf v) { return convert_int(v); }
#else
typedef vf unaligned_vf __attribute__((aligned(4)));
typedef vi unaligned_vi __attribute__((aligned(4)));
typedef LANES_OF(ushort) vs;
typedef vs unaligned_vs __attribute__((aligned(2)));

__constant int LANE_NUMBERS[16] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
INLINE vf load(__global const float *p) { return *(__global const unaligned_vf *)p; }
INLINE void store(vf v, __global float *p) { *(__global unaligned_vf *)p = v; }
INLINE vi iota(void) { return *(__constant const unaligned_vi *)LANE_NUMBERS; }
INLINE void spill(vf v, __private float *p) { *(__private unaligned_vf *)p = v; }
INLINE vf unspill(__private const float *p) { return *(__private const unaligned_vf *)p; }
INLINE void spill_int(vi v, __private int *p) { *(__private unaligned_vi *)p = v; }
INLINE vf to_float(vi v) { return __builtin_convertvector(v, vf); }
INLINE vi to_int(vf v) { return __builtin_convertvector(v, vi); }

// Converts halves with the CPU's instruction, or by their bits, with the same result for finite
// values. It does not use vload_half, a function of PoCL's library. If the library is compiled for
// another CPU than the kernel, the two disagree about the registers of a vector.
#ifdef __F16C__
#if LANES == 8
#define CONVERT_HALVES(v) __builtin_ia32_vcvtph2ps256(v)
#else
#define CONVERT_HALVES(v) \
    __builtin_ia32_vcvtph2ps512_mask(v, __builtin_astype((vf)(0.0f), packed_floats), (ushort)0xffff, 4)
#endif
typedef short packed_halves __attribute__((vector_size(2 * LANES)));
typedef float packed_floats __attribute__((vector_size(4 * LANES)));
INLINE vf load_half(__global const half *p) {
    const vs bits = *(__global const unaligned_vs *)p;
    const packed_floats v = CONVERT_HALVES(__builtin_astype(bits, packed_halves));
    return __builtin_astype(v, vf);
}
#else
// Exponent and mantissa move into place, a subnormal half is its difference from the smallest
// normal one, and the largest exponent stays the largest.
INLINE vf load_half(__global const half *p) {
    const vi bits = __builtin_convertvector(*(__global const unaligned_vs *)p, vi);
    const vi moved = (bits & 0x7fff) << 13;
    const vi normal = moved + 0x38000000;  // (127 - 15) << 23
    const vf small = LANES_OF(as_float)(moved + 0x38800000) - 0x1p-14f;
    const vi finite = moved < 0x00800000 ? LANES_OF(as_int)(small) : normal;
    const vi value = moved < 0x0f800000 ? finite : moved | 0x7f800000;
    return LANES_OF(as_float)(value | (bits & 0x8000) << 16);
}
#endif
#endif

INLINE vf vmin(vf a, vf b) { return a < b ? a : b; }
INLINE vf vmax(vf a, vf b) { return a > b ? a : b; }
INLINE vi vmin_int(vi a, vi b) { return a < b ? a : b; }
INLINE vi vmax_int(vi a, vi b) { return a > b ? a : b; }

// To the nearest whole number, ties to even, for |v| < 2^22.
INLINE vf nearest(vf v) { return (v + 12582912.0f) - 12582912.0f; }

// Whether a comparison holds in any lane.
#if LANES == 1
INLINE bool any_lane(vi mask) { return mask != 0; }
#elif LANES == 8
INLINE bool any_lane(vi mask) {
    const int4 h = mask.lo | mask.hi;
    return (h.x | h.y | h.z | h.w) != 0;
}
#else
INLINE bool any_lane(vi mask) {
    const int8 q = mask.lo | mask.hi;
    const int4 h = q.lo | q.hi;
    return (h.x | h.y | h.z | h.w) != 0;
}
#endif

#if LANES == 1
INLINE vh even_lanes(vu v) { return v; }
INLINE vh odd_lanes(vu v) { return v; }
INLINE vu join_lanes(vh even, vh odd) { return (uint)even; }
#else
#if LANES == 8
#define AS_HALVES as_ulong4
#else
#define AS_HALVES as_ulong8
#endif
// The even and the odd lanes as 64-bit numbers; the upper halves of the even ones are undefined.
INLINE vh even_lanes(vu v) { return AS_HALVES(v); }
INLINE vh odd_lanes(vu v) { return AS_HALVES(v) >> (vh)(32); }
// Back again, from the lower halves.
INLINE vu join_lanes(vh even, vh odd) {
    return LANES_OF(as_uint)((even & (vh)(0xffffffffUL)) | (odd << (vh)(32)));
}
#endif

INLINE vf bits_to_float(vi v) { return LANES_OF(as_float)(v); }
INLINE vi float_bits(vf v) { return LANES_OF(as_int)(v); }
INLINE vi signed_bits(vu v) { return LANES_OF(as_int)(v); }
INLINE vu lane_indices(uint first) { return LANES_OF(as_uint)(iota() + (vi)((int)first)); }
INLINE vf magnitude(vf v) { return bits_to_float(float_bits(v) & 0x7fffffff); }

#endif
