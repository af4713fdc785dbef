// Counter-based random numbers: Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as
// 1, 2, 3", SC 2011), and normals from them. A number is a pure function of the key and of the
// pixel's position, so it does not depend on order, lanes or device.
#ifndef CLPIPE_RANDOM_H
#define CLPIPE_RANDOM_H

typedef struct {
    uint key0, key1;  // 64-bit hash of the noise's scope: image and seed, or camera
    uint stage;       // separates the draws of different stages
} stream;

typedef struct { vu word0, word1, word2, word3; } words;

typedef struct { vh c0, c1, c2, c3; } counters;

// Ten rounds on 64-bit numbers with undefined upper halves, which the multiplication ignores.
INLINE counters philox_rounds(vh c0, vh c1, vh c2, vh c3, stream s) {
    const vh mask = (vh)(0xffffffffUL);
    uint k0 = s.key0, k1 = s.key1;
#pragma unroll
    for (int i = 0; i < 10; ++i) {
        const vh p0 = (c0 & mask) * (vh)(0xD2511F53UL), p1 = (c2 & mask) * (vh)(0xCD9E8D57UL);
        c0 = (p1 >> (vh)(32)) ^ c1 ^ (vh)((ulong)k0);
        c1 = p1;
        c2 = (p0 >> (vh)(32)) ^ c3 ^ (vh)((ulong)k1);
        c3 = p0;
        k0 += 0x9E3779B9u;
        k1 += 0xBB67AE85u;
    }
    const counters c = {c0, c1, c2, c3};
    return c;
}

INLINE words philox(vu x, uint y, uint draw, stream s) {
    const vh c1 = (vh)((ulong)y), c2 = (vh)((ulong)draw), c3 = (vh)((ulong)s.stage);
    const counters even = philox_rounds(even_lanes(x), c1, c2, c3, s);
    const counters odd = LANES == 1 ? even : philox_rounds(odd_lanes(x), c1, c2, c3, s);
    const words w = {join_lanes(even.c0, odd.c0), join_lanes(even.c1, odd.c1),
                     join_lanes(even.c2, odd.c2), join_lanes(even.c3, odd.c3)};
    return w;
}

// A random word as a probability u. Its lower 31 bits give the probability of the nearer tail, u or
// 1 - u, in (0, 1/2]. Its top bit gives the half of the distribution.
INLINE vf tail_probability(vu word) {
    return (to_float(signed_bits(word) & 0x7fffffff) + 0.5f) * 2.3283064e-10f;
}

INLINE vi in_upper_half(vu word) { return signed_bits(word) >= 0; }

// Standard normal from one random word, by inverse CDF. The form is after Giles ("Approximating the
// erfinv function", GPU Computing Gems 2011), a polynomial in sqrt(w), w = -ln(4p(1-p)). The fit is
// our own, with a relative error of 8e-5, up to 6.3 sigma. Only *, + and bit operations, so NumPy
// gives the same bits.
INLINE vf normal_of(vu word) {
    const vf p = tail_probability(word);
    const vf s = square_root(vmax(negative_log(4.0f * p * (1.0f - p)), (vf)(0.0f))) - 2.25f;
    const vf s2 = s * s, s4 = s2 * s2, s8 = s4 * s4;
    const vf z0 = (s * 1.3548409f + 2.9601128f) + (s * -0.076602094f + 0.09441337f) * s2;
    const vf z4 = (s * 0.0062090177f + 0.028542647f) + (s * -0.00031167656f + -0.0069498117f) * s2;
    const vf z8 = (s * 1.8514459e-06f + 0.0008937495f) + s2 * -4.68934e-05f;
    const vf z = ((z0 + z4 * s4) + z8 * s8) * (1.0f - 2.0f * p);
    return bits_to_float(float_bits(z) ^ (signed_bits(word) & (int)0x80000000));
}

// Two independent standard normals from two words (Box and Muller, "A note on the generation of
// random normal deviates", 1958): half the work of two inverse CDFs; up to 6.6 sigma. The radius is
// sqrt(-ln u), since the polynomials for sine and cosine of an eighth of a turn to either side are
// fits of sqrt(2) times these, to 2e-5. One bit for a sign and one for an exchange extend them to a
// whole turn. Only *, + and bit operations, so NumPy gives the same bits.
INLINE pair normals_of(vu distance, vu direction) {
    const vf u = (to_float(signed_bits(distance) & 0x7fffffff) + 0.5f) * 4.6566129e-10f;
    const vf radius = square_root(vmax(negative_log(u), (vf)(0.0f)));
    const vi bits = signed_bits(direction), sign = (bits << 1) & (int)0x80000000;
    const vf f = to_float(bits << 2) * 4.6566129e-10f;
    const vf f2 = f * f;
    const vf sine = ((f2 * 0.0034451601f + -0.11416271f) * f2 + 1.1107191f) * f;
    const vf cosine = (f2 * 0.02173903f + -0.43592441f) * f2 + 1.4141995f;
    const vf signed_cosine = bits_to_float(float_bits(cosine) ^ sign);
    const pair v = {(bits < 0 ? sine : signed_cosine) * radius,
                    (bits < 0 ? signed_cosine : sine) * radius};
    return v;
}

// The random words of a pixel. Four rows share one Philox call, which the compiler detects by
// itself.
INLINE words words_at(site at, uint draw, stream s) {
    return philox(lane_indices(at.x), at.y >> 2, draw, s);
}

INLINE vu word_at(site at, uint draw, stream s) {
    const words w = words_at(at, draw, s);
    const vu upper = (at.y & 1) ? w.word1 : w.word0, lower = (at.y & 1) ? w.word3 : w.word2;
    return (at.y & 2) ? lower : upper;
}

// The normal of a pixel. Two rows share a pair.
INLINE vf normal_at(site at, uint draw, stream s) {
    const words w = words_at(at, draw, s);
    const pair upper = normals_of(w.word0, w.word1), lower = normals_of(w.word2, w.word3);
    return (at.y & 2) ? ((at.y & 1) ? lower.second : lower.first)
                      : ((at.y & 1) ? upper.second : upper.first);
}

// The normal of a row or a column, by its number.
INLINE vf normal_of_line(vu line, stream s) { return normal_of(philox(line, 0, 0, s).word0); }

#endif
