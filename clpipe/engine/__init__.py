"""How a chain runs: plan, generated OpenCL source, compiled programs, buffers, devices.

Modules whose docstring says "Pure" need no device; only this room imports pyopencl.
It knows nothing of files and batches, and imports ``chain`` and below.
"""
