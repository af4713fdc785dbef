"""Calibration: the noise parameters of a sensor from its frames, as a camera profile.

- ``files`` is the complete process, which uses the other modules.
- ``frames`` reads the metadata of each file, and ``groups`` joins frames of one ISO.
- ``calibrate`` estimates the parameters of one ISO.
- ``gain_stages`` splits ISOs where the conversion gain changes.
- ``profile`` writes the TOML, and ``plot`` draws the fit.
- ``line_fit``, ``repeats``, ``single_image``, ``dark``, ``fixed_pattern`` and ``checks`` compute
  statistics of arrays.
"""
