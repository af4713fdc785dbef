// The one channel of a sensor without filters.
INLINE rgb gray(vf y, site at) {
    const rgb v = {y, y, y};
    return v;
}
