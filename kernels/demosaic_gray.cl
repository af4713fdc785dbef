// Copies the channel of a sensor without filters to red, green and blue.
INLINE rgb gray(vf y, site at) {
    const rgb v = {y, y, y};
    return v;
}
