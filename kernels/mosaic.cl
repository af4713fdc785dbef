// The colour filter array: a pixel keeps the one colour that its filter passes.
INLINE vf mosaic(rgb c, site at, cfa pattern) { return by_site(at, pattern, c.r, c.g, c.b); }
