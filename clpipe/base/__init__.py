"""What every other room may use: errors, array types, text and memory helpers, whole-file writes.

Nothing here knows what an image, a stage or a device is. It imports only the standard library and
NumPy.
"""
