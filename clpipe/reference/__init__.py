"""NumPy versions of ``kernels/lib``: the same definitions, file by file, for the references.

Each function of a kernel header has the same name here. Up to the raw, both return the same bits.
No module here knows stages or devices. The package imports only ``base``.
"""
