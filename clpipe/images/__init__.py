"""Files of pixels: reading and writing EXR, JPEG, PNG, TIFF, DNG, camera raws and headerless dumps.

This room turns files into arrays and plain values, and back. Rooms above it decide which stage an
image enters and which pictures are written. It imports ``stage`` and below, and is the only room
that imports OpenImageIO, OpenEXR, Pillow, rawpy and exifread.
"""
