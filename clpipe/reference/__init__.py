"""NumPy twins of ``kernels/lib``: the same definitions, file by file, for the references."""
