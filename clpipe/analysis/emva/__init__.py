"""EMVA 1288: characterizes sensors from series of uniform frames, and simulates such series.

"EMVA 1288" is the "Standard for Characterization of Image Sensors and Cameras" of the European
Machine Vision Association, release 3.1 (2016). The parts of rows and columns follow release 4.0
(2021).

- ``series`` reads and writes the text that describes a series.
- ``moments`` reduces frames to means and variances.
- ``figures`` computes the figures of the standard, and ``plot`` draws them.
- ``sensor`` and ``profile`` convert figures to a camera profile.
- ``simulation`` makes a series of a camera.
"""
