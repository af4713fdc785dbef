"""NumPy twins of ``kernels/lib``: the same definitions, file by file, for the references.

A function of a kernel header has the same name here and, for everything up to the raw, gives the
same bits. Nothing here knows stages or devices. This room imports ``base`` only.
"""
