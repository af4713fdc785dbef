"""Datasets of scenes: Blender in a process of its own, the views, and the set's card.

May import: base, reference, images, inputs, outputs.
"""
