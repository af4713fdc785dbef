"""Datasets of scenes: Blender in a separate process, the views, and the dataset's card.

May import: base, reference, images, inputs, outputs.
"""
