"""Noise parameters of a sensor from its frames: statistics on arrays, a profile, a picture."""
