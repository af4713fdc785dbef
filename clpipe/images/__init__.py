"""Files of pixels: reading and writing EXR, JPEG, PNG, TIFF, DNG, camera raws and headerless dumps.

Pixels and metadata pass through here as arrays and plain values; which stage they enter, or which
pictures are wanted, is decided above. It imports ``stages`` and below, and is the only room that
imports OpenImageIO, OpenEXR, Pillow, rawpy and exifread.
"""
