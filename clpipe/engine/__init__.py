"""How a chain runs: plan, generated OpenCL source, compiled programs, buffers, devices.

A module whose docstring says "Pure" needs no device. Only this package imports pyopencl. It does
not know image files or batches, and imports ``chain`` and below.
"""
