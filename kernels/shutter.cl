// Flickering light on rows that are exposed one after the other. One launch fills a table with the
// gain of each row, 1 + swing * cos(2 pi (row * step + start)). The pixels are then multiplied by
// the gain of their row.
INLINE vf flicker_of_rows(vu row, float step, float start, float swing) {
    const vf turns = to_float(signed_bits(row)) * step + start;
    // cos(2 pi u) = sin(2 pi (1/4 - |u|)) for |u| <= 1/2, by Taylor's series to the ninth power.
    const vf x = (0.25f - magnitude(turns - nearest(turns))) * 6.2831853f, xx = x * x;
    const vf sine =
        x * (1.0f + xx * (-1.0f / 6 + xx * (1.0f / 120 + xx * (-1.0f / 5040 + xx / 362880))));
    return 1.0f + swing * sine;
}

// Light that is on in the first `duty` of each period. `step` between rows, and the `start` of the
// first row's exposure, are in 2^-32 periods. An exposure takes `rest` of a period in addition to
// whole ones, whose contribution is `steady`.
INLINE vf pulses_of_rows(vu row, uint step, uint start, float rest, float duty, float steady, float scale) {
    const vf begins = to_float(signed_bits((row * (vu)(step) + (vu)(start)) >> (vu)(8))) * 0x1p-24f;
    const vf ends = begins + rest, none = (vf)(0.0f);
    const vf first = vmin(ends, (vf)(duty)) - begins;
    const vf second = vmin(ends, (vf)(1.0f + duty)) - 1.0f;
    return steady + scale * (vmax(first, none) + vmax(second, none));
}

INLINE rgb flicker(rgb c, site at, __global const float *rows) {
    const float gain = rows[at.y];
    const rgb v = {c.r * gain, c.g * gain, c.b * gain};
    return v;
}
