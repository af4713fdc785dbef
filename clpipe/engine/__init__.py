"""How a chain runs: plan, generated OpenCL source, compiled programs, buffers, devices.

``plan``, ``codegen`` and ``tiles`` are pure and need no device; only this room imports pyopencl.
It knows nothing of files and batches, and imports ``chain`` and below.
"""
