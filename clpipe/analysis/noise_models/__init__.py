"""Converts noise models of other programs to camera profiles.

``read`` converts a file to the text of a profile. It finds from the contents whether ``dng``,
``android`` or ``darktable`` reads the file. Each of these returns a ``model.SensorModel``, from
which ``model`` writes the profile.
"""
