"""Helpers that every other room may use: errors, array types, text, memory, files, validation, CPU time.

Nothing here knows what an image, a stage or a device is. This room imports only the standard
library, NumPy and pydantic.
"""
