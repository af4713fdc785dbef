"""EMVA 1288: a sensor's figures from a series of uniform frames, and series of a camera.

"EMVA 1288" is the European Machine Vision Association's standard 1288, "Standard for
Characterization of Image Sensors and Cameras", release 3.1 (2016); the parts of rows and columns
are those of release 4.0 (2021).

``series`` reads and writes the text that describes a series, ``moments`` reduces its frames to
means and variances, ``figures`` makes the standard's figures of these, ``plot`` draws them,
``sensor`` and ``profile`` say which camera has them, and ``simulation`` makes a series of a camera.
"""
