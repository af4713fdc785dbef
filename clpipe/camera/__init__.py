"""Cameras: profiles of sensors and the noise model, and lenses by their names.

A profile is a TOML file, built-in or written by a user. It gives the noise parameters a and b at an
ISO. No module here reads images or knows the chain. The package imports only ``base``.
"""
