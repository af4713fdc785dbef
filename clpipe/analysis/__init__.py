"""Noise, measured: statistics of images, and the calibration of a camera from its frames.

It works on arrays and on files that ``images`` reads, and never develops pictures. It imports
``outputs`` and below, and is the only room that imports SciPy and Matplotlib.
"""
