"""Shot and read noise of the sensor."""

from collections.abc import Mapping
from dataclasses import replace
from math import isclose
from typing import ClassVar, Self

import numpy as np
from pydantic import model_validator

from clpipe.base.errors import RequestError
from clpipe.base.types import Floats
from clpipe.camera.noise import Emva, NoiseModel, Paper
from clpipe.reference.math import square_root
from clpipe.reference.poisson import poisson_of
from clpipe.reference.random import normal_at, word_at
from clpipe.reference.tukey_lambda import shape_and_scale, tukey_lambda_of
from clpipe.stage import Argument, Context, Frame, Kind, Method, NoiseScope, Pass, Stage, parameter

EMVA = ("system_gain", "read_noise", "adc_noise")
PAPER = ("chi", "theta", "b_before", "b_after", "p0")
NEVER_FULL = 1e30


def _or(given: float | None, known: float) -> float:
    """What is given, else what is known."""
    return known if given is None else given


class SensorNoise(Method):
    """How strong the noise is, said in one of three ways, and what bounds it.

    What is left out follows from the camera and the ISO. Subclasses draw the noise.
    """

    a: float | None = parameter(
        None,
        "Shot noise: variance a unit of signal.",
        "signal",
        "from the camera and ISO",
        ge=0,
        le=1,
    )
    b: float | None = parameter(
        None,
        "Read noise: variance without light.",
        "signal^2",
        "from the camera and ISO",
        ge=0,
        le=1,
    )
    system_gain: float | None = parameter(
        None, "Instead of a: what an electron is worth (EMVA 1288).", "DN/e-", "not used", gt=0
    )
    read_noise: float | None = parameter(
        None, "Instead of b: noise before the gain (EMVA 1288).", "e-", "not used", ge=0
    )
    adc_noise: float | None = parameter(
        None, "With read_noise: noise after the gain.", "DN", "not used", ge=0
    )
    chi: float | None = parameter(
        None, "Instead of a and b: electrons at y = 1, theta = 1.", "e-", "not used", gt=0
    )
    theta: float | None = parameter(None, "With chi: the analogue gain.", "", "not used", gt=0)
    b_before: float | None = parameter(
        None, "With chi: b', variance before the gain.", "signal^2", "not used", ge=0
    )
    b_after: float | None = parameter(
        None, "With chi: b'', variance after the gain.", "signal^2", "not used", ge=0
    )
    p0: float | None = parameter(None, "With chi: the pedestal.", "signal", "not used", ge=0)
    full_well: float | None = parameter(
        None, "The most electrons that a pixel holds.", "e-", "from the camera; else no limit", gt=0
    )
    tukey_lambda: float | None = parameter(
        None,
        "Shape of the read noise; 0.14 is nearly Gaussian, below it has heavier tails.",
        "",
        "from the camera; else Gaussian",
        gt=-0.5,
        le=1,
    )

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        emva, paper = self._given(EMVA), self._given(PAPER)
        if emva and paper:
            raise ValueError(
                f"noise is given in one way, EMVA 1288's or the paper's; "
                f"found {', '.join(emva)} and {', '.join(paper)}"
            )
        if paper and (self.chi is None or self.theta is None):
            raise ValueError(f"the paper's parameters need both chi and theta; found {paper}")
        return self

    def _given(self, names: tuple[str, ...]) -> list[str]:
        return [name for name in names if getattr(self, name) is not None]

    def model(self, context: Context) -> NoiseModel:
        """The noise, from what is given and, for the rest, from the camera at the ISO.

        Raises:
            RequestError: a and b are given and do not agree with what else is given, or b comes
                out negative, or the ISO is outside the camera's range.
        """
        camera = context.camera.noise(context.iso)
        unit = camera.signal_range
        known, law = camera.emva(), camera.paper()
        assert known and law  # a camera's gain is above 0
        other = self._given(EMVA) or self._given(PAPER)
        if self.chi and self.theta:
            before, after = _or(self.b_before, law.b_before), _or(self.b_after, law.b_after)
            a, b = Paper(self.chi, self.theta, before, after, self.p0 or 0.0).signal()
            if b < 0:
                raise RequestError(f"sensor_noise: p0 = {self.p0:g} makes b negative, {b:.4g}")
            model = NoiseModel(a, b, unit, min(after, b), self.theta)
        elif other:
            gain = _or(self.system_gain, known.system_gain)
            after = _or(self.adc_noise, known.adc_noise)
            a, b = Emva(gain, _or(self.read_noise, known.read_noise), after).signal(unit)
            model = NoiseModel(a, b, unit, (after / unit) ** 2, camera.theta)
        else:
            a, b = _or(self.a, camera.a), _or(self.b, camera.b)
            return camera if (a, b) == (camera.a, camera.b) else NoiseModel(a, b, unit)
        for name, given, found in (("a", self.a, model.a), ("b", self.b, model.b)):
            if given is not None and not isclose(given, found, rel_tol=1e-6):
                raise RequestError(
                    f"sensor_noise: noise is given in one way; found {name} = {given:g} beside "
                    f"{', '.join(other)}, which comes to {name} = {found:g}"
                )
        return model

    def resolve(self, context: Context) -> Self:
        model, camera = self.model(context), context.camera
        filled = self.filled(a=model.a, b=model.b, tukey_lambda=camera.tukey_lambda)
        return filled.filled(full_well=camera.full_well)

    def after(self, context: Context) -> Context:
        return replace(context, noise=self.model(context))

    def without_noise(self) -> Method | None:
        full = self.full_signal
        return None if full is None else NoNoise(full_signal=full)

    @property
    def full_signal(self) -> float | None:
        """The signal at which the well is full; None without a limit, or where a is 0 and an
        electron is worth nothing.
        """
        return self.full_well * self.a if self.full_well and self.a else None

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        """a*y + b, y from 0 to the full well (of which it is not modelled that it cuts noise)."""
        return self.added(np.maximum(signal, np.float32(0))) + before

    def added(self, signal: Floats) -> Floats:
        """The variance of this noise, a*y + b, y at most the full well."""
        y = np.minimum(signal, np.float32(_or(self.full_signal, NEVER_FULL)))
        return y * np.float32(self.a) + np.float32(self.b)

    def values(self) -> dict[str, np.float32]:
        """The kernel's arguments, by name."""
        raise NotImplementedError(type(self).__name__)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return self.values()

    def read_values(self) -> dict[str, np.float32]:
        """Those of read noise: its sigma and, where it is no Gaussian, its law."""
        assert self.b is not None
        sigma = {"read_noise": np.float32(self.b**0.5)}
        if self.tukey_lambda is None:
            return sigma
        shape, scale = shape_and_scale(self.tukey_lambda)
        return {**sigma, "shape": shape, "scale": scale}

    def read_reference(self, image: Floats, frame: Frame) -> Floats:
        """Read noise of variance 1, in NumPy."""
        stream = frame.stream[NoiseScope.IMAGE]
        if self.tukey_lambda is None:
            return normal_at(image.shape, 1, stream)
        words = word_at(image.shape, 1, stream)
        return tukey_lambda_of(words, *shape_and_scale(self.tukey_lambda))


class Gaussian(SensorNoise):
    """Heteroscedastic Gaussian, Var[y] = a*y + b (Foi et al., IEEE TIP 2008, eq. 2).

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Gaussian(a=1e-3, b=1e-4), np.full((300, 300), 0.5, np.float32))
    >>> round(float(noisy.mean()), 2), round(float(noisy.var()), 4)
    (0.5, 0.0006)
    """

    method: ClassVar = "gaussian"
    kernel: ClassVar = "sensor_noise_gaussian"
    summary: ClassVar = "add Gaussian noise of variance a*y + b"
    other_examples: ClassVar = ({"tukey_lambda": -0.2, "full_well": 1000.0},)

    def passes(self) -> tuple[Pass, ...]:
        if self.tukey_lambda is None:
            return (
                Pass("sensor_noise", arguments=("a", "b", "full_well"), random=NoiseScope.IMAGE),
            )
        names = ("a", "full_well", "read_noise", "shape", "scale")
        return (Pass("sensor_noise_tukey", arguments=names, random=NoiseScope.IMAGE),)

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        if self.tukey_lambda is None:  # below 0 it goes on to fall
            return np.maximum(self.added(signal), np.float32(0)) + before
        return super().variance(before, signal, context)

    def values(self) -> dict[str, np.float32]:
        full = np.float32(_or(self.full_signal, NEVER_FULL))
        signal = {"a": np.float32(self.a), "full_well": full}
        if self.tukey_lambda is None:
            return {**signal, "b": np.float32(self.b)}
        return {**signal, **self.read_values()}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        given = self.values()
        normals = normal_at(image.shape, 0, frame.stream[NoiseScope.IMAGE])
        variance = given["a"] * image + given.get("b", np.float32(0))
        noise = normals * square_root(np.maximum(variance, np.float32(0)))
        noisy = np.minimum(image + noise, given["full_well"])
        if self.tukey_lambda is None:
            return noisy
        return noisy + self.read_reference(image, frame) * given["read_noise"]


class Poisson(SensorNoise):
    """Whole photo-electrons, Poisson at mean y / a, plus read noise of variance b (EMVA 1288).

    Light below 0 gives no electrons. Drawn by inverse CDF (Giles, ACM TOMS 42(1), 2016).

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(Poisson(a=1e-3, b=1e-4), np.full((300, 300), 0.5, np.float32))
    >>> round(float(noisy.mean()), 2), round(float(noisy.var()), 4)
    (0.5, 0.0006)
    """

    method: ClassVar = "poisson"
    kernel: ClassVar = "sensor_noise_poisson"
    summary: ClassVar = "draw whole photo-electrons at the gain and add read noise"
    other_examples: ClassVar = (
        {"a": 0.05, "b": 1e-4},
        {"tukey_lambda": -0.2, "full_well": 1000.0},
    )

    def resolve(self, context: Context) -> Self:
        resolved = super().resolve(context)
        if not resolved.a:
            raise RequestError(
                "sensor_noise: poisson needs an a above 0; without shot noise use gaussian"
            )
        return resolved

    def passes(self) -> tuple[Pass, ...]:
        gaussian = self.tukey_lambda is None
        names = ("chi", "full_well", "a", "read_noise")
        return (
            Pass(
                "sensor_noise_poisson" if gaussian else "sensor_noise_poisson_tukey",
                arguments=names if gaussian else (*names, "shape", "scale"),
                random=NoiseScope.IMAGE,
            ),
        )

    def values(self) -> dict[str, np.float32]:
        assert self.a
        return {
            "chi": np.float32(1 / self.a),
            "full_well": np.float32(self.full_well or NEVER_FULL),
            "a": np.float32(self.a),
            **self.read_values(),
        }

    def reference(self, image: Floats, frame: Frame) -> Floats:
        given = self.values()
        words = word_at(image.shape, 0, frame.stream[NoiseScope.IMAGE])
        mean = np.maximum(image, np.float32(0)) * given["chi"]
        electrons = np.minimum(poisson_of(mean, words), given["full_well"])
        return electrons * given["a"] + self.read_reference(image, frame) * given["read_noise"]


class NoNoise(Method):
    """No noise; but a full well is no noise, and stays.

    >>> from clpipe.stage import run_reference
    >>> run_reference(NoNoise(full_signal=0.5), np.float32([[0.25, 0.75]])).tolist()
    [[0.25, 0.5]]
    """

    method: ClassVar = "none"
    kernel: ClassVar = "full_well"
    summary: ClassVar = "no noise; only a full well clips"
    example: ClassVar = {"full_signal": 0.5}

    full_signal: float | None = parameter(
        None,
        "The signal at which the well is full.",
        "signal",
        "from the camera and ISO; else no limit",
        gt=0,
    )

    def resolve(self, context: Context) -> "NoNoise":
        camera = context.camera
        known = camera.signal_of(camera.full_well, context.iso) if camera.full_well else None
        return self.filled(full_signal=known)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("full_well", arguments=("full_signal",)),) if self.full_signal else ()

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"full_signal": np.float32(_or(self.full_signal, NEVER_FULL))}

    def variance(self, before: Floats, signal: Floats, context: Context) -> Floats:
        return before

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return np.minimum(image, np.float32(_or(self.full_signal, NEVER_FULL)))


STAGE = Stage(
    "sensor_noise",
    "Add shot and read noise.",
    Kind.MOSAIC,
    Kind.MOSAIC,
    (Gaussian, Poisson, NoNoise),
)
