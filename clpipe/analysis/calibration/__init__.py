"""Noise parameters of a sensor from its frames: statistics on arrays, a profile, a picture.

``frames`` groups files by ISO; ``calibrate`` finds the parameters of one ISO; ``profile`` writes
what was found as a camera profile. It imports ``images`` and ``camera``, and no device.
"""
