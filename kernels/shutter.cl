// Light that flickers, as rows see it that are exposed one after the other. One launch fills a table with
// the gain of each row, 1 + swing * cos(2 pi (row * cycles + start)); the pixels are then multiplied by that
// of their row.
INLINE vf flicker_of_rows(vu row, float cycles, float start, float swing) {
    const vf turns = to_float(signed_bits(row)) * cycles + start;
    // cos(2 pi u) = sin(2 pi (1/4 - |u|)) for |u| <= 1/2, by Taylor's series to the ninth power.
    const vf x = (0.25f - magnitude(turns - nearest(turns))) * 6.2831853f, xx = x * x;
    const vf sine =
        x * (1.0f + xx * (-1.0f / 6 + xx * (1.0f / 120 + xx * (-1.0f / 5040 + xx / 362880))));
    return 1.0f + swing * sine;
}

INLINE rgb flicker(rgb c, site at, __global const float *rows) {
    const float gain = rows[at.y];
    const rgb v = {c.r * gain, c.g * gain, c.b * gain};
    return v;
}
