"""Requests: from what the user asks for to a resolved chain of stages.

TOML, ``--set``, manifest rows and sidecars become a :class:`~clpipe.chain.request.Request`, then
:class:`~clpipe.chain.settings.Settings`, then a :class:`~clpipe.chain.chain.Chain`; random draws,
truths and the registry of stages also belong here. The package does not handle pixels or devices.
It imports ``images`` (for the tables that describe files) and below.
"""
