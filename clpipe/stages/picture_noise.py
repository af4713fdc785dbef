"""Noise on the finished picture, as synthetic data usually has it: baselines to compare with.

Real noise arises before the processing, which shapes it; see ``sensor_noise``. Here independent
noise is added after the processing, with a sigma of the user's or of ``clpipe measure --json``.
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import BeforeValidator, Field, field_validator, model_validator

from clpipe.base.errors import RequestError
from clpipe.base.reading import check_regular, parse_json, read_bytes
from clpipe.base.types import Floats
from clpipe.reference.curve import to_8_bit
from clpipe.reference.random import normal_at
from clpipe.stage import (
    Argument,
    Context,
    Frame,
    Kind,
    Method,
    NoiseScope,
    Pass,
    Stage,
    Unchanged,
    parameter,
)

ENTRIES = 256  # of the kernel's table
RESOLVED = 65  # entries of a measured curve in the resolved parameters, and so in the sidecar
CHANNELS = Kind.DISPLAY.channels

Sigma = Annotated[float, Field(ge=0, le=1)]
Sigmas = Annotated[tuple[Sigma, ...], Field(min_length=2, max_length=ENTRIES)]


class NoNoise(Unchanged):
    """No noise on the finished picture."""

    method: ClassVar = "none"
    summary: ClassVar = "no noise here; sensor_noise adds it where a sensor does"


def _as_three(value: Any) -> Any:
    """One number as three equal ones, and a list, as TOML has it, as a tuple."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        return (float(value),) * 3
    return tuple(value) if isinstance(value, list) else value


def _as_tuples(value: Any) -> Any:
    """Nested lists, as TOML has them, as the tuples that strict validation needs."""
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value


class IndependentNoise(Method):
    """Gaussian noise, independent in each pixel, channel and image; sigma is set or measured."""

    alternatives: ClassVar = frozenset({"sigma", "measured"})

    measured: str = parameter(
        "",
        "A report of clpipe measure --json on finished pictures; the noise gets its sigma.",
        file=True,
    )

    @field_validator("measured")
    @classmethod
    def _readable(cls, path: str) -> str:
        if path:
            measured_noise(path)
        return path

    @model_validator(mode="after")
    def _at_most_one(self) -> Self:
        if getattr(self, "sigma", None) is not None and self.measured:
            raise ValueError("found both sigma and measured; set one of them")
        return self

    def noise(self) -> tuple["ChannelNoise", ...]:
        """The measured noise of red, green and blue.

        Raises:
            RequestError: neither sigma nor a report is set. It is refused as late as here because
                options may choose the method, and each row of a manifest its report.
        """
        if not self.measured:
            raise RequestError(
                "picture_noise: needs sigma, or measured, a report of clpipe measure --json"
            )
        return measured_noise(self.measured)


class IidGaussian(IndependentNoise):
    """v + sigma * n: independent Gaussian noise of one sigma, the usual baseline.

    v is a display value, 0..1; n is a standard normal for each pixel and channel.

    >>> from clpipe.stage import run_reference
    >>> noisy = run_reference(IidGaussian(sigma=0.02), np.full((300, 300, 3), 0.5, np.float32))
    >>> noisy.std((0, 1)).round(3).tolist()
    [0.019999999552965164, 0.019999999552965164, 0.019999999552965164]
    """

    method: ClassVar = "iid_gaussian"
    kernel: ClassVar = "picture_noise_iid_gaussian"
    summary: ClassVar = "independent Gaussian noise of one sigma: the usual baseline"
    example: ClassVar = {"sigma": [0.05, 0.02, 0.1]}

    sigma: Annotated[tuple[Sigma, Sigma, Sigma], BeforeValidator(_as_three)] | None = parameter(
        None,
        "Standard deviation: one number, or one each for red, green and blue.",
        "of full scale",
        "as measured",
    )

    def resolve(self, context: Context) -> "IidGaussian":
        if self.sigma is not None:
            return self
        return self.filled(sigma=tuple(noise.sigma for noise in self.noise()))

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("picture_noise", arguments=("red", "green", "blue"), random=NoiseScope.IMAGE),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        assert self.sigma is not None
        return dict(zip(("red", "green", "blue"), map(np.float32, self.sigma), strict=True))

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return image + _normals(image, frame) * np.array(self.sigma, np.float32)


class IntensityDependent(IndependentNoise):
    """v + sigma(v) * n: independent Gaussian noise whose sigma follows each channel's intensity.

    SyB3R adds such noise to finished pictures (Ley, Haensch, Hellwich, "SyB3R: A realistic
    synthetic benchmark for 3D reconstruction from images", ECCV 2016). v is a display value, 0..1,
    n a standard normal for each pixel and channel; sigma(v) comes from a table. Beyond the measured
    intensities, sigma stays that of the nearest one.

    >>> from clpipe.stage import run_reference
    >>> grey = np.full((300, 300, 3), 0.5, np.float32)
    >>> noisy = run_reference(IntensityDependent(sigma=(0.01, 0.03)), grey)
    >>> bool(abs(noisy.std() - 0.02) < 1e-3)
    True
    """

    method: ClassVar = "intensity_dependent"
    kernel: ClassVar = "picture_noise_intensity_dependent"
    summary: ClassVar = "independent Gaussian noise, sigma from a table by intensity (SyB3R)"
    example: ClassVar = {"sigma": [0.01, 0.08, 0.03]}

    sigma: Annotated[Sigmas | tuple[Sigmas, Sigmas, Sigmas], BeforeValidator(_as_tuples)] | None = (
        parameter(
            None,
            "Standard deviations at intensities evenly spaced from 0 to 1, linear between them: "
            "one list, or one each for red, green and blue.",
            "of full scale",
            "as measured",
        )
    )

    def resolve(self, context: Context) -> "IntensityDependent":
        if self.sigma is not None:
            return self
        places = np.linspace(0, 1, RESOLVED)
        curves = (np.interp(places, c.intensity, c.sigmas) for c in self.noise())
        return self.filled(sigma=tuple(tuple(curve.round(6).tolist()) for curve in curves))

    def table(self) -> Floats:
        """Sigma at the 256 intensities v = i / 255 of red, of green and of blue, (768,)."""
        assert self.sigma is not None
        return _table(self.sigma)

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("picture_noise", arguments=("sigmas",), random=NoiseScope.IMAGE),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"sigmas": self.table()}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        place = to_8_bit(image) + np.arange(3) * ENTRIES
        return image + _normals(image, frame) * self.table()[place]


def _normals(image: Floats, frame: Frame) -> Floats:
    """A standard normal for each sample, (height, width, 3), of the image's stream."""
    stream = frame.stream[NoiseScope.IMAGE]
    return np.stack([normal_at(image.shape, draw, stream) for draw in range(3)], axis=-1)


@lru_cache(maxsize=16)
def _table(sigma: tuple[Any, ...]) -> Floats:
    places = np.linspace(0, 1, ENTRIES)
    curves = sigma if isinstance(sigma[0], tuple) else (sigma,) * 3
    each = [np.interp(places, np.linspace(0, 1, len(curve)), curve) for curve in curves]
    return np.concatenate(each).astype(np.float32)


class ChannelNoise(NamedTuple):
    """The measured noise of one channel, in display values, 0..1.

    ``sigma`` is that of all samples; ``sigmas`` are those at each ``intensity``, ascending.
    """

    sigma: float
    intensity: tuple[float, ...]
    sigmas: tuple[float, ...]


def measured_noise(path: str) -> tuple[ChannelNoise, ...]:
    """The noise of red, green and blue in a report of ``clpipe measure --json``.

    The file is read again when it changes.

    Raises:
        ValueError: the file cannot be read, is not such a report, or does not report on display
            values.
    """
    try:
        status = check_regular(Path(path))
        return _measured_noise(path, status.st_mtime_ns, status.st_size)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None


@lru_cache(maxsize=16)
def _measured_noise(path: str, time: int, size: int) -> tuple[ChannelNoise, ...]:
    try:
        report = parse_json(read_bytes(Path(path)))
        kind, channels = report["kind"], report["channels"]
        if kind == Kind.DISPLAY.label:
            return tuple(_channel_of(channels[name]) for name in CHANNELS)
    except (ValueError, OverflowError, LookupError, TypeError, AttributeError):
        raise ValueError("not a report of clpipe measure --json") from None
    raise ValueError(
        f"reports on {kind}, but this noise is in display values; "
        "measure finished pictures (JPEG, PNG, or EXR kept after gamma)"
    )


def _channel_of(record: Any) -> ChannelNoise:
    curve = record["intensity"]
    mean, sigma = (tuple(float(x) for x in curve[key]) for key in ("mean", "sigma"))
    noise = ChannelNoise(float(record["sigma"]), mean, sigma)
    is_curve = 0 < len(mean) == len(sigma)
    are_noise = all(0 <= value <= 1 for value in (noise.sigma, *sigma))
    if not (is_curve and are_noise and np.isfinite(mean).all()):
        raise TypeError
    return noise


STAGE = Stage(
    "picture_noise",
    "Add noise to the finished picture, as a baseline.",
    Kind.DISPLAY,
    Kind.DISPLAY,
    (NoNoise, IidGaussian, IntensityDependent),
)
