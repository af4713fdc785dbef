"""Measurement of noise: statistics of images, camera calibration, imported noise models.

The package also matches a camera's development, meters the exposures of a sequence and compares
images in figures. It works on arrays and on files that ``images`` reads. Only ``matching`` develops
images; ``metering`` runs a chain up to its exposure, and ``emva`` runs one up to its raw. The
package imports ``outputs`` and below. Only this package imports SciPy and Matplotlib.
"""
