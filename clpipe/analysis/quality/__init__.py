"""Image quality of cameras in the figures of the field.

It renders charts, develops them with a chain, and measures the pictures. Pictures of real charts
are measured in the same way.
"""
