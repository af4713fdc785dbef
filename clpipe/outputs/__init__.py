"""Output files: which pictures of an image are written, in which formats, with which sidecar.

:mod:`~clpipe.outputs.plan` names the files that a run writes. :mod:`~clpipe.outputs.recipes` lists
the steps of each picture. :mod:`~clpipe.outputs.existing` finds the files of earlier runs, and
:mod:`~clpipe.outputs.writer` writes the rest. :mod:`~clpipe.outputs.sidecar` reads and writes
sidecars, and :mod:`~clpipe.outputs.record` defines their contents. ``photographs`` and
``annotations`` read an output directory through its sidecars.

The package decides names and contents; ``images`` encodes the files. It imports ``inputs`` and
below, and starts no threads.
"""
