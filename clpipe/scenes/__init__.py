"""Datasets of scenes: Blender in a separate process, the views, and the dataset's card.

The package may import base, reference, images, inputs and outputs.
"""
