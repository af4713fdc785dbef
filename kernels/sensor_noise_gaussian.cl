// Shot and read noise of a sensor as one heteroscedastic Gaussian, Var[y] = a*y + b
// (Foi et al. 2008, eq. 2).
INLINE vf sensor_noise(vf y, site at, stream s, float a, float b) {
    return y + normal_at(at, 0, s) * square_root(most(a * y + b, (vf)(0.0f)));
}
