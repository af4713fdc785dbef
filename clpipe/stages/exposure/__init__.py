"""Exposure: how much light of the scene the sensor gets, by a number, by metering or by physics."""

from clpipe.stage import Kind, Stage, StageRole
from clpipe.stages.exposure.auto import Auto
from clpipe.stages.exposure.gain import Gain
from clpipe.stages.exposure.photometric import Photometric

STAGE = Stage(
    "exposure",
    "Brighten or darken the scene.",
    Kind.RGB,
    Kind.RGB,
    (Gain, Auto, Photometric),
    role=StageRole.EXPOSURE,
)
