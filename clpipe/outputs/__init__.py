"""What is written of an image: which pictures, in which formats, with which sidecar.

:mod:`~clpipe.outputs.plan` names the files that a run writes, :mod:`~clpipe.outputs.recipes` says
how each picture is made, :mod:`~clpipe.outputs.existing` finds what is there already, and
:mod:`~clpipe.outputs.writer` writes the rest. :mod:`~clpipe.outputs.sidecar` reads and writes
sidecars, :mod:`~clpipe.outputs.record` says what is in them. ``photographs`` and ``annotations``
read an output folder by its sidecars.

The room decides names and contents, and leaves encoding to ``images``. It imports ``inputs`` and
below, and starts no threads.
"""
