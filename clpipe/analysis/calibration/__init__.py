"""Calibration: the noise parameters of a sensor from its frames, as a camera profile.

``files`` is the whole way: ``frames`` reads what each file says of its camera, ``groups`` joins
frames of one ISO, ``calibrate`` estimates the parameters of one ISO, ``gain_stages`` cuts ISOs
where the conversion gain changes, ``profile`` writes the TOML and ``plot`` draws the fit. The
statistics behind ``calibrate`` work on arrays alone: ``line_fit``, ``repeats``, ``single_image``,
``dark``, ``fixed_pattern``, ``checks``.
"""
