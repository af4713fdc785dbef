"""Measurement of noise: statistics of images, and cameras, calibrated or of others' noise models.

This room works on arrays and on files that ``images`` reads; it never develops pictures. It imports
``outputs`` and below, and is the only room that imports SciPy and Matplotlib.
"""
