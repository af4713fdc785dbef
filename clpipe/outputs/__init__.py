"""Outputs: the pictures of an image, their formats, and their sidecars.

- :mod:`~clpipe.outputs.plan` names the files that a run writes.
- :mod:`~clpipe.outputs.recipes` lists the chain of each picture.
- :mod:`~clpipe.outputs.existing` finds files that exist already.
- :mod:`~clpipe.outputs.writer` writes the rest.
- :mod:`~clpipe.outputs.sidecar` reads and writes sidecars.
- :mod:`~clpipe.outputs.record` makes the contents of sidecars.
- ``output_pictures`` and ``annotations`` read the sidecars of an output directory.

This package decides names and contents, and leaves encoding to ``images``. It imports ``inputs``
and below, and starts no threads.
"""
