"""NumPy counterparts of ``kernels/lib``: the same definitions, file by file, for references.

A function has the same name as in the kernel header. For everything up to the raw image, it also
gives the same bits. Nothing here depends on stages or devices. This package imports ``base`` only.
"""
