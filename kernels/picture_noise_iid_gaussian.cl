// Gaussian noise of one sigma for each channel, independent in each pixel.
#include "lib/correlated.h"

INLINE rgb picture_noise(rgb c, site at, stream s, float red, float green, float blue, float green_red,
                         float green_green, float blue_red, float blue_green, float blue_blue) {
    const rgb n = correlated_normals(at, s, green_red, green_green, blue_red, blue_green, blue_blue);
    const rgb v = {c.r + n.r * red, c.g + n.g * green, c.b + n.b * blue};
    return v;
}
