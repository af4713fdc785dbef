// A wave over the rows, with a new phase in each frame. Only * and +, so that NumPy gives the same
// bits.
#include "lib/random.h"

INLINE vf wave_of_lines(vu line, stream s, float frequency, float amplitude) {
    const vu word = philox((vu)(0u), 0, 0, s).word0;
    const vf phase = to_float(signed_bits(word >> (vu)(1u))) * 4.6566129e-10f;
    const vf turns = to_float(signed_bits(line)) * frequency + phase;
    const vf part = turns - nearest(turns);  // -0.5..0.5
    const vf z = 0.25f - magnitude(magnitude(part) - 0.25f), z2 = z * z;
    const vf sine = ((((z2 * 42.058693f + -76.705859f) * z2 + 81.605249f) * z2 + -41.341702f) * z2 + 6.2831853f) * z;
    return (part < 0.0f ? -sine : sine) * amplitude;
}

INLINE vf banding(vf y, site at, __global const float *wave) { return y + wave[at.y]; }
