"""Cameras: profiles of sensors and the noise model, and lenses by their names.

Nothing here reads images or knows the chain; a profile, one of the built-in TOML files or a user's,
answers "what is a and b at this ISO".
It imports ``base`` only.
"""
