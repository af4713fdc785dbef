// A 3x3 matrix times the colour of each pixel.
INLINE rgb color_matrix(rgb c, site at, float rr, float rg, float rb, float gr, float gg, float gb,
                        float br, float bg, float bb) {
    const rgb v = {rr * c.r + rg * c.g + rb * c.b, gr * c.r + gg * c.g + gb * c.b,
                   br * c.r + bg * c.g + bb * c.b};
    return v;
}
