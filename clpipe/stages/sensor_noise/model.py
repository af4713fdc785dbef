"""The strength of sensor noise: its parameters, and the noise model that they define."""

from math import isclose
from typing import Any, Self

import numpy as np
from pydantic import model_validator

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.camera.noise import Emva, NoiseModel, Paper
from clpipe.reference.tukey_lambda import shape_and_scale
from clpipe.stage import (
    Arguments,
    Backend,
    Context,
    Method,
    Numbers,
    Signal,
    SignalMethod,
    camera_parameter,
    parameter,
)
from clpipe.stages.sensor_noise.no_noise import NEVER_FULL, NoNoise, or_default

EMVA = ("system_gain", "read_noise", "adc_noise")
PAPER = ("chi", "theta", "b_before", "b_after", "p0")


def shot_noise_parameter(auto: str) -> Any:
    """Declare the parameter a. ``auto`` is as for :func:`~clpipe.stage.parameter`."""
    text = "Shot noise: the variance per unit of signal."
    return parameter(None, text, "signal", auto, ge=0, le=1)


def read_noise_parameter(auto: str) -> Any:
    """Declare the parameter b. ``auto`` is as for :func:`~clpipe.stage.parameter`."""
    text = "Read noise: the variance without light."
    return parameter(None, text, "signal^2", auto, ge=0, le=1)


def alternative(text: str, unit: str = "", **limits: Any) -> Any:
    """Declare a parameter of a parametrisation that may replace a and b."""
    return parameter(None, text, unit, "not used", **limits)


class SensorNoise(SignalMethod):
    """The strength of the noise in one of three parametrisations, and the full well.

    The parametrisations are described in :mod:`clpipe.camera.noise`: a and b, EMVA 1288's or the
    paper's (Bielova et al. 2019). Parameters that are not set follow from the camera and the ISO.
    Subclasses draw the noise.
    """

    a: float | None = shot_noise_parameter("from the camera and ISO")
    b: float | None = read_noise_parameter("from the camera and ISO")
    system_gain: float | None = alternative(
        "Instead of a: the system gain (EMVA 1288).", "DN/e-", gt=0
    )
    read_noise: float | None = alternative(
        "Instead of b: standard deviation of the noise before the gain (EMVA 1288).", "e-", ge=0
    )
    adc_noise: float | None = alternative(
        "With read_noise: standard deviation of the noise after the gain.", "DN", ge=0
    )
    chi: float | None = alternative(
        "Instead of a and b, with theta: electrons at y = 1 and theta = 1 (Bielova et al. 2019).",
        "e-",
        gt=0,
    )
    theta: float | None = alternative("With chi: the analogue gain (Bielova et al. 2019).", gt=0)
    b_before: float | None = alternative(
        "With chi: b', the variance of the noise before the gain (Bielova et al. 2019).",
        "signal^2",
        ge=0,
    )
    b_after: float | None = alternative(
        "With chi: b'', the variance of the noise after the gain (Bielova et al. 2019).",
        "signal^2",
        ge=0,
    )
    p0: float | None = alternative("With chi: the pedestal (Bielova et al. 2019).", "signal", ge=0)
    full_well: float | None = camera_parameter(
        "Largest number of electrons that a pixel holds.", "e-", more="; else no limit", gt=0
    )
    tukey_lambda: float | None = camera_parameter(
        "Shape of the read noise: 0.14 is nearly Gaussian, and lower values have heavier tails.",
        more="; else Gaussian",
        gt=-0.5,
        le=1,
    )

    @model_validator(mode="after")
    def _check_parametrisation(self) -> Self:
        emva, paper = self._set_names(EMVA), self._set_names(PAPER)
        if emva and paper:
            raise ValueError(
                f"found parameters of EMVA 1288 ({', '.join(emva)}) and of Bielova et al. 2019 "
                f"({', '.join(paper)}); use only one of these parametrisations"
            )
        if paper and (self.chi is None or self.theta is None):
            raise ValueError(
                "the parameters of Bielova et al. 2019 need both chi and theta; only "
                f"{', '.join(paper)} is set"
            )
        return self

    def _set_names(self, names: tuple[str, ...]) -> list[str]:
        return [name for name in names if getattr(self, name) is not None]

    def model(self, context: Context) -> NoiseModel:
        """Return the noise model: the parameters that are set, else the camera's at the ISO.

        Raises:
            RequestError: a or b is set and contradicts another parametrisation that is set, or b
                becomes negative, or the ISO is outside the camera's range.
        """
        camera = context.camera.noise(context.iso)
        unit = camera.signal_range
        emva, paper = camera.emva(), camera.paper()
        assert emva and paper  # a camera's gain is above 0
        names = self._set_names(EMVA) or self._set_names(PAPER)
        if self.chi and self.theta:
            before = or_default(self.b_before, paper.b_before)
            after = or_default(self.b_after, paper.b_after)
            a, b = Paper(self.chi, self.theta, before, after, self.p0 or 0.0).signal()
            if b < 0:
                raise RequestError(
                    f"sensor_noise: p0 = {self.p0:g} makes b negative, {b:.4g}; lower p0"
                )
            model = NoiseModel(a, b, unit, min(after, b), self.theta)
        elif names:
            gain = or_default(self.system_gain, emva.system_gain)
            read_noise = or_default(self.read_noise, emva.read_noise)
            after = or_default(self.adc_noise, emva.adc_noise)
            a, b = Emva(gain, read_noise, after).signal(unit)
            model = NoiseModel(a, b, unit, (after / unit) ** 2, camera.theta)
        else:
            a, b = or_default(self.a, camera.a), or_default(self.b, camera.b)
            return camera if (a, b) == (camera.a, camera.b) else NoiseModel(a, b, unit)
        for name, set_value, derived in (("a", self.a, model.a), ("b", self.b, model.b)):
            if set_value is not None and not isclose(set_value, derived, rel_tol=1e-6):
                raise RequestError(
                    f"sensor_noise: set the noise in one parametrisation; {name} = {set_value:g} "
                    f"contradicts {', '.join(names)}, which give {name} = {derived:g}"
                )
        return model

    def resolve(self, context: Context) -> Self:
        model, camera = self.model(context), context.camera
        resolved = self.with_defaults(
            a=model.a, b=model.b, tukey_lambda=camera.tukey_lambda_at(context.iso)
        )
        return resolved.with_defaults(full_well=camera.full_well)

    def next_context(self, context: Context) -> Context:
        return context.replace(noise=self.model(context))

    def without_noise(self) -> Method | None:
        full = self.full_signal
        return None if full is None else NoNoise.model_construct(full_signal=full)

    @property
    def full_signal(self) -> float | None:
        """The signal at which the well is full; None without a full well, or if a is 0."""
        return self.full_well * self.a if self.full_well and self.a else None

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats | None:
        """The variance a*y + b, with y clipped to 0..full well, without the cut of noise there."""
        return self.added_variance(np.maximum(signal, np.float32(0))) + input_variance

    def added_variance(self, signal: Floats) -> Floats:
        """The variance of this stage's noise, a*y + b, y at most the full well; signal squared."""
        y = np.minimum(signal, np.float32(or_default(self.full_signal, NEVER_FULL)))
        return y * np.float32(self.a) + np.float32(self.b)

    def read_noise_numbers(self) -> Arguments:
        """Return the kernel's arguments for read noise: sigma and, if not Gaussian, its shape."""
        assert self.b is not None
        sigma: Arguments = {"read_noise": self.b**0.5}
        if self.tukey_lambda is None:
            return sigma
        shape, scale = shape_and_scale(self.tukey_lambda)
        return {**sigma, "shape": shape, "scale": scale}


def unit_read_noise(n: Numbers, backend: Backend) -> Signal:
    """Return read noise of variance 1 for each pixel: Gaussian, or Tukey lambda."""
    if "shape" not in n:
        return backend.normals(1)
    return backend.tukey_lambda(backend.words(1), n["shape"], n["scale"])
