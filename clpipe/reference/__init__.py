"""NumPy twins of ``kernels/lib``: the same definitions, file by file, for the references.

What a kernel header defines has the same name here and, up to the raw, the same bits. Nothing here
knows stages or devices. It imports ``base`` only.
"""
