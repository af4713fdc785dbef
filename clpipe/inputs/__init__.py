"""Inputs: which files a run processes, and at which stage each enters a chain.

Folders, globs and manifests become jobs. Renders, camera raws, dumps and kept images become pixels
with a chain. No module here develops or writes images. The package imports ``chain`` and below.
"""
