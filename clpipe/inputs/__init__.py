"""Inputs: which files a run is about, and how each enters a chain.

Folders, globs and manifests become jobs; renders, camera raws, dumps and kept images become pixels
with a chain. Nothing is developed or written here. This room imports ``chain`` and below.
"""
