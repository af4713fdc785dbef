"""Analysis of images and cameras.

It measures the noise of images, calibrates cameras, imports noise models of other programs, and
matches the development of a camera. It also draws comparisons of pictures.

This package works on arrays, and on files that ``images`` reads. Only ``matching`` develops
pictures, and ``emva`` runs a chain up to its raw. The package imports ``outputs`` and below. No
other package imports SciPy or Matplotlib.
"""
