// Noise of whole rows or columns, from the readout. One launch fills a table with one offset per
// line. Each pixel then adds the offset of its line.
INLINE vf noise_of_lines(vu line, stream s, float sigma) { return normal_of_line(line, s) * sigma; }

INLINE vf row_noise(vf y, site at, __global const float *lines) { return y + lines[at.y]; }

INLINE vf column_noise(vf y, site at, __global const float *lines) {
    return y + load(lines + at.x);
}
