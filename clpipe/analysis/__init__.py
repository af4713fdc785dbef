"""Measurement of noise: statistics of images, and the calibration of a camera from its frames.

This room works on arrays and on files that ``images`` reads; it never develops pictures. It imports
``outputs`` and below, and is the only room that imports SciPy and Matplotlib.
"""
