"""Helpers that every other room may use: errors, array types, texts, memory, files, clocks.

Nothing here knows what an image, a stage or a device is. ``system`` has what only some systems
have, and what stands in for it. This room imports the standard library, NumPy, pydantic and fsspec.
"""
