// One exposure read several times, each less sensitive than the one before, and merged.
//
// A readout has noise, whole DN and a white level of its own. Where one comes near its white level, the next one
// takes over, over a tenth of the range.
#define HANDOVER_BEGINS 0.85f
#define HANDOVER_ENDS 0.95f

// `shared`: all read the same charge, so its shot noise is the same; else each has light of its own. `part` is the
// readout that is looked at alone, or -1.
INLINE vf readouts(vf y, site at, stream s, int count, int shared, int part, float a, float b, float later_b,
                   float full_well, float down, float up, float range, float unit) {
    vf charge = y;
    if (shared) charge = vmin(y + normal_at(at, 0, s) * square_root(vmax(a * y, (vf)(0.0f))), (vf)(full_well));
    vf values[4], weights[4];
    float sensitivity = 1.0f, inverse = 1.0f;
    for (int i = 0; i < count; ++i) {
        const float own_b = i ? later_b : b;
        const vf light = charge * sensitivity;
        const vf variance = shared ? (vf)(own_b) : vmax(a * light + own_b, (vf)(0.0f));
        const vf noisy = light + normal_at(at, (uint)(i + shared), s) * square_root(variance);
        const vf read = vmin(nearest(noisy * range) * unit, (vf)(1.0f));
        values[i] = read * inverse;
        weights[i] = vmin(vmax((HANDOVER_ENDS - read) * 10.0f, (vf)(0.0f)), (vf)(1.0f));
        sensitivity *= down;
        inverse *= up;
    }
    if (part >= 0) return values[part];
    vf merged = values[count - 1];
    for (int i = count - 2; i >= 0; --i)
        merged = weights[i] * values[i] + (1.0f - weights[i]) * merged;
    return merged;
}
