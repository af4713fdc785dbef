"""Image files: reading and writing EXR, JPEG, PNG, TIFF, DNG, videos, camera raws and dumps.

The package converts files to arrays and plain values, and back. Higher packages decide at which
stage an image enters the chain, and which images are written. The package imports ``stage`` and
below. Only this package imports OpenImageIO, OpenEXR, Pillow, PyAV and rawpy.
"""
