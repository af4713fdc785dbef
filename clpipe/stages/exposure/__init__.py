"""Exposure: the light that the sensor gets, set by a number, by metering or by physics."""

from clpipe.stage import StageRole, rgb_stage
from clpipe.stages.exposure.auto import Auto
from clpipe.stages.exposure.gain import Gain
from clpipe.stages.exposure.photometric import Photometric
from clpipe.stages.exposure.radiometric import Radiometric

STAGE = rgb_stage(
    "exposure",
    "Scale the light that the sensor gets.",
    (Gain, Auto, Photometric, Radiometric),
    role=StageRole.EXPOSURE,
)
