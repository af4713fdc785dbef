// Conversion to and from luma and chroma, for every denoising method.
INLINE ycbcr to_luma_chroma(rgb c, site at) { return rgb_to_ycbcr(c); }
INLINE rgb from_luma_chroma(ycbcr c, site at) { return ycbcr_to_rgb(c); }
