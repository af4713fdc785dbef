"""Measurement of noise: statistics of images; cameras, calibrated or of others' noise models;
and the development of a camera, matched. And of light: the exposures of a sequence. And pictures
compared, as figures.

This room works on arrays and on files that ``images`` reads; only ``matching`` develops pictures,
``metering`` runs a chain as far as its exposure, and ``emva`` one as far as its raw. It imports
``outputs`` and below, and is the only room that imports SciPy and Matplotlib.
"""
