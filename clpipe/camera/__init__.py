"""Cameras: profiles of sensors, the noise model, and lenses by name.

A profile is a built-in TOML file or your own, and gives a and b at an ISO. Nothing here reads
images or depends on the chain. This package imports ``base`` only.
"""
