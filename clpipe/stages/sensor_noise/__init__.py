"""Sensor noise: shot noise and read noise."""

from clpipe.stage import StageRole, sensor_stage
from clpipe.stages.sensor_noise.gaussian import Gaussian
from clpipe.stages.sensor_noise.no_noise import NoNoise
from clpipe.stages.sensor_noise.poisson import Poisson
from clpipe.stages.sensor_noise.readouts import DualGain
from clpipe.stages.sensor_noise.skewed_gaussian import SkewedGaussian
from clpipe.stages.sensor_noise.split_pixel import SplitDualGain, SplitPixel
from clpipe.stages.sensor_noise.staggered import Staggered

STAGE = sensor_stage(
    "sensor_noise",
    "Add shot and read noise.",
    (SkewedGaussian, Gaussian, Poisson, DualGain, SplitPixel, SplitDualGain, Staggered, NoNoise),
    role=StageRole.SENSOR_NOISE,
)
