"""Requests: from the user's options to a resolved chain of stages.

TOML, ``--set``, manifest rows and sidecars become a :class:`~clpipe.chain.request.Request`, then
:class:`~clpipe.chain.settings.Settings`, then a :class:`~clpipe.chain.chain.Chain`. Random draws,
ground truth and the registry of stages are also in this package. It handles no pixels and no
devices. It imports ``images`` (for the tables that describe files) and the packages below it.
"""
