"""Helpers that every other room may use: errors, array types, texts, memory, files, clocks.

Nothing here knows what an image, a stage or a device is. What only some systems have is used in
``system`` alone. This room imports only the standard
library, NumPy and pydantic.
"""
