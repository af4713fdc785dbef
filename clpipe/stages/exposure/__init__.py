"""Exposure: the light that the sensor gets, set by a number, by metering or by physics."""

from clpipe.stage import Kind, Stage, StageRole
from clpipe.stages.exposure.auto import Auto
from clpipe.stages.exposure.gain import Gain
from clpipe.stages.exposure.photometric import Photometric

STAGE = Stage(
    "exposure",
    "Scale the light that the sensor gets.",
    Kind.RGB,
    Kind.RGB,
    (Gain, Auto, Photometric),
    role=StageRole.EXPOSURE,
)
