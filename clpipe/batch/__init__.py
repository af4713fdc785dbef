"""Many images: threads, Dask workers, tars, resuming, replaying, logging and tracing.

One class decodes, develops and encodes one image. The other modules do that for many images at
once. The package imports ``outputs`` and below, never ``analysis`` or ``commands``.
"""
