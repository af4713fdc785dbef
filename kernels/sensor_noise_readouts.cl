// One exposure that is read several times, each less sensitive than the last, and merged.
//
// Each readout has its own noise, rounding to whole DN, and white level. When a readout comes close
// to its white level, the next one takes over, over a tenth of the range.
#define HANDOVER_ENDS 0.95f
#define READOUTS 4  // at most

// For each readout, `table` has the number of its photodiode, the share of light of this
// photodiode, the gain, the factor for merging, and the variance of its read noise. Readouts of one
// photodiode are consecutive, and have the same charge. `part` is the only readout to return, or
// -1.
//
// `later` has the light of all photodiodes but the first in their own exposures: planes of
// `columns` by `rows` with one more vector at the right, or 0 if all see the same light. For an
// image larger than these planes, as in a check of the kernel, the last row and vector are
// repeated.
INLINE vf merged(vf y, site at, stream s, bool is_noisy, int count, int part, float a, float full_well, float range,
                 float unit, __global const float *table, __global const float *later, int columns, int rows) {
    const int last_x = columns - LANES, last_y = rows - 1;
    const int x = (int)at.x < last_x ? (int)at.x : last_x, line = (int)at.y < last_y ? (int)at.y : last_y;
    vf values[READOUTS], weights[READOUTS], charge = y;
    int photodiode = -1;
    for (int i = 0; i < count; ++i) {
        __global const float *readout = table + 5 * i;
        if ((int)readout[0] != photodiode) {
            photodiode = (int)readout[0];
            const bool is_later = later && photodiode;
            const vf incident = is_later ? load(later + ((long)(photodiode - 1) * rows + line) * columns + x) : y;
            vf light = incident * readout[1];
            if (is_noisy)
                light += normal_at(at, (uint)photodiode, s) * square_root(vmax(a * light, (vf)(0.0f)));
            charge = vmin(light, (vf)(full_well));
        }
        vf read = charge * readout[2];
        if (is_noisy) {
            const vf noisy = read + normal_at(at, (uint)(READOUTS + i), s) * square_root((vf)(readout[4]));
            read = nearest(noisy * range) * unit;
        }
        read = vmin(read, (vf)(1.0f));
        values[i] = read * readout[3];
        weights[i] = vmin(vmax((HANDOVER_ENDS - read) * 10.0f, (vf)(0.0f)), (vf)(1.0f));
    }
    if (part >= 0) return values[part];
    vf result = values[count - 1];
    for (int i = count - 2; i >= 0; --i)
        result = weights[i] * values[i] + (1.0f - weights[i]) * result;
    return result;
}

INLINE vf readouts(vf y, site at, stream s, int count, int part, float a, float full_well, float range, float unit,
                   __global const float *table) {
    return merged(y, at, s, true, count, part, a, full_well, range, unit, table, 0, 0, 0);
}

INLINE vf exposures(vf y, site at, stream s, int count, int part, float a, float full_well, float range, float unit,
                    __global const float *table, __global const float *later, int columns, int rows) {
    return merged(y, at, s, true, count, part, a, full_well, range, unit, table, later, columns, rows);
}

// Without noise and rounding.
INLINE vf clean_readouts(vf y, site at, int count, int part, float full_well, __global const float *table) {
    const stream none = {0, 0, 0};
    return merged(y, at, none, false, count, part, 0.0f, full_well, 1.0f, 1.0f, table, 0, 0, 0);
}

INLINE vf clean_exposures(vf y, site at, int count, int part, float full_well, __global const float *table,
                          __global const float *later, int columns, int rows) {
    const stream none = {0, 0, 0};
    return merged(y, at, none, false, count, part, 0.0f, full_well, 1.0f, 1.0f, table, later, columns, rows);
}
