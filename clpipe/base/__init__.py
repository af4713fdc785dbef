"""Helpers that every other room may use: errors, array types, texts, memory, files, clocks.

Nothing here knows what an image, a stage or a device is. This room imports only the standard
library, NumPy and pydantic.
"""
