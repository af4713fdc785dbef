"""Noise on the finished picture: what synthetic data usually gets, as baselines to compare with.

Real noise comes before the processing, which shapes it; see ``sensor_noise``. Here the same sigma,
given or as ``clpipe measure --json`` found it, is added after it, to a clean picture.
"""

import json
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import BeforeValidator, Field, field_validator, model_validator

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

ENTRIES = 256
RESOLVED = 65  # entries of a measured curve, as the sidecar has it
CHANNELS = Kind.DISPLAY.channels

Sigma = Annotated[float, Field(ge=0, le=1)]
Sigmas = Annotated[tuple[Sigma, ...], Field(min_length=2, max_length=ENTRIES)]


class NoNoise(Unchanged):
    """Noise belongs before the processing."""

    method: ClassVar = "none"
    summary: ClassVar = "no noise here; it was added where a sensor adds it"


def _as_three(value: Any) -> Any:
    """One number as the same for red, green and blue; a list, as TOML has it, as a tuple."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        return (float(value),) * 3
    return tuple(value) if isinstance(value, list) else value


def _as_tuples(value: Any) -> Any:
    """Lists, as TOML has them, as the tuples that strict validation wants."""
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value


class Matched(Method):
    """Gaussian noise, new in each pixel, channel and image; its sigma is given or measured."""

    measured: str = parameter(
        "",
        "A report of clpipe measure --json on finished pictures, whose noise to match.",
        file=True,
    )

    @field_validator("measured")
    @classmethod
    def _readable(cls, path: str) -> str:
        if path:
            measured_noise(path)
        return path

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        given = getattr(self, "sigma", None) is not None
        if given and self.measured:
            raise ValueError("found both sigma and measured; give one of them")
        if not given and not self.measured:
            raise ValueError("needs sigma, or measured, the file of a clpipe measure --json")
        return self


class IidGaussian(Matched):
    """Independent Gaussian noise of one sigma: the usual baseline.

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
        "Standard deviation; one number, or one each for red, green and blue.",
        "of full scale",
        "as measured",
    )

    def resolve(self, context: Context) -> "IidGaussian":
        if self.sigma is not None:
            return self
        return self.filled(sigma=tuple(noise.sigma for noise in measured_noise(self.measured)))

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("picture_noise", arguments=("red", "green", "blue"), random=NoiseScope.IMAGE),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        assert self.sigma is not None
        return dict(zip(("red", "green", "blue"), map(np.float32, self.sigma), strict=True))

    def reference(self, image: Floats, frame: Frame) -> Floats:
        return image + _normals(image, frame) * np.array(self.sigma, np.float32)


class IntensityDependent(Matched):
    """Independent Gaussian noise whose sigma follows the intensity of each channel.

    As SyB3R adds it to finished pictures (Ley, Haensch, Hellwich, "SyB3R: A realistic synthetic
    benchmark for 3D reconstruction from images", ECCV 2016): sigma by intensity, as a table. Beyond
    the intensities that were measured the last sigma holds.

    >>> from clpipe.stage import run_reference
    >>> grey = np.full((300, 300, 3), 0.5, np.float32)
    >>> noisy = run_reference(IntensityDependent(sigma=(0.01, 0.03)), grey)
    >>> bool(abs(noisy.std() - 0.02) < 1e-3)
    True
    """

    method: ClassVar = "intensity_dependent"
    kernel: ClassVar = "picture_noise_intensity_dependent"
    summary: ClassVar = "independent Gaussian noise, sigma by intensity as a table (SyB3R)"
    example: ClassVar = {"sigma": [0.01, 0.08, 0.03]}

    sigma: Annotated[Sigmas | tuple[Sigmas, Sigmas, Sigmas], BeforeValidator(_as_tuples)] | None = (
        parameter(
            None,
            "Standard deviations at intensities evenly spaced from 0 to 1, lines between; one "
            "list, or one each for red, green and blue.",
            "of full scale",
            "as measured",
        )
    )

    def resolve(self, context: Context) -> "IntensityDependent":
        if self.sigma is not None:
            return self
        places = np.linspace(0, 1, RESOLVED)
        curves = (np.interp(places, c.intensity, c.sigmas) for c in measured_noise(self.measured))
        return self.filled(sigma=tuple(tuple(curve.round(6).tolist()) for curve in curves))

    def table(self) -> Floats:
        """Sigma at 256 intensities of red, of green and of blue, (768,)."""
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
    """A standard normal a sample, of the image's own stream."""
    stream = frame.stream[NoiseScope.IMAGE]
    return np.stack([normal_at(image.shape, draw, stream) for draw in range(3)], axis=-1)


@lru_cache(maxsize=16)
def _table(sigma: tuple[Any, ...]) -> Floats:
    places = np.linspace(0, 1, ENTRIES)
    curves = sigma if isinstance(sigma[0], tuple) else (sigma,) * 3
    each = [np.interp(places, np.linspace(0, 1, len(curve)), curve) for curve in curves]
    return np.concatenate(each).astype(np.float32)


class ChannelNoise(NamedTuple):
    """The noise of one channel: sigma, and sigma by intensity."""

    sigma: float
    intensity: tuple[float, ...]
    sigmas: tuple[float, ...]


def measured_noise(path: str) -> tuple[ChannelNoise, ...]:
    """The noise of red, green and blue in a report of ``clpipe measure --json``.

    Read again when the file changes.

    Raises:
        ValueError: it cannot be read, is no such report, or reports on something else than display
            values.
    """
    try:
        status = Path(path).stat()
        return _measured_noise(path, status.st_mtime_ns, status.st_size)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None


@lru_cache(maxsize=16)
def _measured_noise(path: str, time: int, size: int) -> tuple[ChannelNoise, ...]:
    try:
        report = json.loads(Path(path).read_text("utf-8"))
        kind, channels = report["kind"], report["channels"]
        if kind != Kind.DISPLAY.label:
            raise ValueError(
                f"reports on {kind}, but this noise is in display values; "
                "measure finished pictures (JPEG, PNG, or EXR kept after gamma)"
            )
        return tuple(_channel_of(channels[name]) for name in CHANNELS)
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError):
        raise ValueError("not a report of clpipe measure --json") from None


def _channel_of(record: Any) -> ChannelNoise:
    curve = record["intensity"]
    mean, sigma = (tuple(float(x) for x in curve[key]) for key in ("mean", "sigma"))
    noise = ChannelNoise(float(record["sigma"]), mean, sigma)
    numbers = np.array([noise.sigma, *mean, *sigma])
    if not mean or len(mean) != len(sigma) or not np.isfinite(numbers).all() or min(sigma) < 0:
        raise TypeError
    return noise


STAGE = Stage(
    "picture_noise",
    "Add noise to the finished picture, as a baseline.",
    Kind.DISPLAY,
    Kind.DISPLAY,
    (NoNoise, IidGaussian, IntensityDependent),
)
