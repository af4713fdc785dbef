"""Noise models of others as camera profiles.

``read`` is the whole way, from a file to a profile's text: it tells by what a file holds which of
``dng``, ``android`` and ``darktable`` reads it. Each of these makes a ``model.SensorModel``, of
which ``model`` writes the profile.
"""
