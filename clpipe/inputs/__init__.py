"""Inputs: the files that a run processes, and the chain of each.

Folders, globs and manifests become jobs. Renders, camera raws, dumps and intermediate images become
pixels with a chain. Nothing is developed or written here. This package imports ``chain`` and below.
"""
