"""Inputs: the files that a run processes, and the chain of each.

Folders, globs and manifests become jobs. Renders, camera raws, dumps and intermediate images become
pixels with a chain. Only ``metering`` runs chains, up to the exposure of frames. This package
imports ``engine`` and below.
"""
