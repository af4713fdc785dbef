// Veiling glare: a share of all light is spread evenly over the image.
#define GLARE_STEPS 4096.0f  // per unit of light
#define GLARE_MOST 256.0f    // so that the sums of blocks fit in 32 bits

// Of each 2x2 pixels, red of the first, green of the next two, and blue of the last.
INLINE vi glare_sample(rgb c, site at) {
    const bool below = at.y & 1;
    const vi right = (iota() + (vi)((int)at.x)) & 1;
    const vf left_light = below ? c.g : c.r, right_light = below ? c.b : c.g;
    const vf light = right == 1 ? right_light : left_light;
    return to_int(nearest(vmin(vmax(light, (vf)(0.0f)), (vf)(GLARE_MOST)) * GLARE_STEPS));
}

// `share` of the mean of a colour; without such a pixel, in an image of one row or column, that of
// another colour.
INLINE void glare_mean(long4 sums, float share, extent e, __global float *estimates) {
    const long even_x = (e.width + 1) / 2, odd_x = e.width / 2;
    const long even_y = (e.height + 1) / 2, odd_y = e.height / 2;
    const long greens = odd_x * even_y + even_x * odd_y, blues = odd_x * odd_y;
    const float red = (float)sums.x / (float)(even_x * even_y);
    const float green = greens ? (float)(sums.y + sums.z) / (float)greens : red;
    const float blue = blues ? (float)sums.w / (float)blues : green;
    estimates[0] = red * (share / GLARE_STEPS);
    estimates[1] = green * (share / GLARE_STEPS);
    estimates[2] = blue * (share / GLARE_STEPS);
}

INLINE rgb glare(rgb c, site at, float kept, float red, float green, float blue) {
    const rgb v = {c.r * kept + red, c.g * kept + green, c.b * kept + blue};
    return v;
}
