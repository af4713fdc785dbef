"""clpipe puts a clean, linear render through a camera: mosaic, sensor noise, development."""

__version__ = "0.1.0"
