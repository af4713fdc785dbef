"""Helpers for every other package: errors, array types, text, memory, files, clocks.

No module here knows images, stages or devices. ``system`` contains the functions that only some
operating systems have, and their substitutes. The package imports the standard library, NumPy,
pydantic and fsspec.
"""
