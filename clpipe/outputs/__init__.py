"""What is written of an image: which pictures, in which formats, with which sidecar.

It decides names and contents, and leaves encoding to ``images``. It imports ``inputs`` and below,
and starts no threads.
"""
