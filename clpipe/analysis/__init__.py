"""Measurement of noise: statistics of images; cameras, calibrated or of others' noise models;
and the development of a camera, matched.

This room works on arrays and on files that ``images`` reads; only ``matching`` develops pictures.
It imports ``outputs`` and below, and is the only room that imports SciPy and Matplotlib.
"""
