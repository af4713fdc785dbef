"""Measurement of noise: statistics of images, calibration of a camera, matching of a development.

This room works on arrays and on files that ``images`` reads; only ``matching`` develops pictures.
It imports ``outputs`` and below, and is the only room that imports SciPy and Matplotlib.
"""
