"""Many images: threads, Dask workers, tars, resuming, replaying, logging and tracing.

One image's decoding, development and encoding are methods of one class; everything here is about
doing that to many at once. It imports ``outputs`` and below, never ``analysis`` or ``commands``.
"""
