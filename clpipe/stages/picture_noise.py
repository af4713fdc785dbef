"""Noise on the finished image, like in most synthetic data: baselines for comparison.

Real noise arises before the processing, which shapes it; see ``sensor_noise``. The methods here add
independent noise to each pixel after the processing. You set sigma, or take it from ``clpipe
measure --json`` or from the image itself (``clpipe run --truth iid``).
"""

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import BeforeValidator, Field, field_validator, model_validator

from clpipe.base.errors import RequestError
from clpipe.base.reading import cached_by_mtime, parse_json, read_bytes
from clpipe.base.types import Floats
from clpipe.reference.correlated import correlated_normals, mixing
from clpipe.reference.curve import to_8_bit
from clpipe.stage import (
    Argument,
    Arguments,
    Context,
    Kind,
    Method,
    NoiseScope,
    Pass,
    ReferenceContext,
    Stage,
    StageRole,
    Unchanged,
    parameter,
)

TABLE_SIZE = 256  # entries of the kernel's table
UNKNOWN = "unknown"  # the ISO of images without a stated ISO, in a report
RESOLVED_SIZE = 65  # entries of a measured curve in the resolved parameters, and so in the sidecar
CHANNELS = Kind.DISPLAY.channels
# Kernel arguments.
MIXING_NAMES = ("green_red", "green_green", "blue_red", "blue_green", "blue_blue")

Sigma = Annotated[float, Field(ge=0, le=1)]
Sigmas = Annotated[tuple[Sigma, ...], Field(strict=False, min_length=2, max_length=TABLE_SIZE)]


Correlation = Annotated[float, Field(ge=-1, le=1)]


class NoiseMatching(Method):
    """Parameters for matching the noise of the finished image to measured noise."""

    match: Literal["picture", "flat", "halved"] = parameter(
        "picture",
        "Where the variance equals the measured one: in the whole image, in its flat areas, or "
        "in the whole image after averaging 2x2 pixels.",
    )
    correlated: bool = parameter(
        False, "Draw red, green and blue with the measured correlation between them."
    )


class NoNoise(Unchanged, NoiseMatching):
    """No noise on the finished image; with ``clpipe run --truth iid``, how to match the noise."""

    summary: ClassVar = "no noise on the finished image"

    jpeg: bool = parameter(
        False,
        "Match the noise of --truth in the decoded JPEG, which preserves more of a camera's "
        "noise than of independent noise.",
    )


def _per_channel(value: Any) -> Any:
    """Convert one number to three equal ones, and a list, which TOML gives, to a tuple."""
    if isinstance(value, float | int) and not isinstance(value, bool):
        return (float(value),) * 3
    return tuple(value) if isinstance(value, list) else value


class IndependentNoise(NoiseMatching):
    """Gaussian noise, independent in each pixel and image; sigma is set or measured."""

    alternatives: ClassVar = frozenset({"sigma", "measured"})

    measured: str = parameter(
        "",
        "Report of clpipe measure --json on finished images, from which sigma is taken.",
        file=True,
    )
    correlation: (
        Annotated[tuple[Correlation, Correlation, Correlation], Field(strict=False)] | None
    ) = parameter(
        None,
        "Correlation of red with green, of red with blue, and of green with blue.",
        "",
        "as measured if correlated is true, else 0",
    )

    @field_validator("measured")
    @classmethod
    def _check_report(cls, path: str) -> str:
        if path:
            measured_noise(path)
        return path

    @field_validator("correlation")
    @classmethod
    def _check_correlation(cls, values: tuple[float, float, float] | None) -> Any:
        if values:
            mixing(*values)
        return values

    @model_validator(mode="after")
    def _check_source(self) -> Self:
        if getattr(self, "sigma", None) is not None and self.measured:
            raise ValueError("sigma and measured are both set; set one of them")
        return self

    def noise(self, iso: float) -> "MeasuredNoise":
        """The measured noise for this kind of matching.

        Args:
            iso: ISO of the image; a report may contain several.

        Raises:
            RequestError: neither sigma nor a report is set, or the report contains other ISOs. The
                check is this late because options may choose the method, and each row of a manifest
                its report.
        """
        if not self.measured:
            raise RequestError(
                "picture_noise: set sigma, or set measured to a report of clpipe measure --json"
            )
        by_iso = measured_noise(self.measured)
        noise = by_iso.get(iso, by_iso.get(None))
        if noise is None:
            found = ", ".join(f"{each:g}" for each in by_iso if each is not None)
            raise RequestError(
                f"picture_noise.measured: {self.measured} does not contain ISO {iso:g}; it "
                f"contains {found}"
            )
        return noise[self.match]

    def with_correlation(self, iso: float) -> Self:
        """Return a copy with the correlation that is set or measured.

        Raises:
            RequestError: the measured correlation is requested, but no report is set.
        """
        if self.correlation is not None or not self.correlated:
            return self.with_defaults(correlation=(0.0, 0.0, 0.0))
        if not self.measured:
            raise RequestError(
                "picture_noise: correlated is true, but no measured noise is set; set "
                "correlation, or set measured to a report of clpipe measure --json"
            )
        return self.with_defaults(correlation=self.noise(iso).correlation)

    def normals(self, image: Floats, inputs: ReferenceContext) -> Floats:
        """Return the normals of each sample, (height, width, 3), from the image's stream."""
        assert self.correlation is not None
        stream = inputs.stream[NoiseScope.IMAGE]
        return correlated_normals(image.shape, stream, mixing(*self.correlation))

    def mixing_arguments(self) -> dict[str, Argument]:
        """Return the kernel's arguments for the correlation."""
        assert self.correlation is not None
        return dict(zip(MIXING_NAMES, mixing(*self.correlation), strict=True))


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
    example: ClassVar = {"sigma": [0.05, 0.02, 0.1], "correlation": [0.6, -0.3, 0.5]}

    sigma: Annotated[tuple[Sigma, Sigma, Sigma], BeforeValidator(_per_channel)] | None = parameter(
        None,
        "Standard deviation: one number, or one each for red, green and blue.",
        "of full scale",
        "as measured",
    )

    def resolve(self, context: Context) -> "IidGaussian":
        correlated = self.with_correlation(context.iso)
        if self.sigma is not None:
            return correlated
        return correlated.with_defaults(sigma=self.noise(context.iso).sigma)

    def passes(self) -> tuple[Pass, ...]:
        names = ("red", "green", "blue", *MIXING_NAMES)
        return (Pass("picture_noise", arguments=names, random=NoiseScope.IMAGE),)

    def arguments(self, context: Context) -> Arguments:
        assert self.sigma is not None
        sigmas = zip(("red", "green", "blue"), self.sigma, strict=True)
        return {**dict(sigmas), **self.mixing_arguments()}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        return image + self.normals(image, inputs) * np.array(self.sigma, np.float32)


class IntensityDependent(IndependentNoise):
    """v + sigma(v) * n: independent Gaussian noise whose sigma follows each channel's intensity.

    SyB3R adds such noise to finished images (Ley, Haensch, Hellwich, "SyB3R: A realistic synthetic
    benchmark for 3D reconstruction from images", ECCV 2016). In the formula, v is a display value,
    0..1, and n a standard normal for each pixel and channel. sigma(v) comes from a table. Outside
    the measured intensities, sigma is taken from the nearest one.

    >>> from clpipe.stage import run_reference
    >>> grey = np.full((300, 300, 3), 0.5, np.float32)
    >>> noisy = run_reference(IntensityDependent(sigma=(0.01, 0.03)), grey)
    >>> bool(abs(noisy.std() - 0.02) < 1e-3)
    True
    """

    method: ClassVar = "intensity_dependent"
    kernel: ClassVar = "picture_noise_intensity_dependent"
    summary: ClassVar = "independent Gaussian noise, sigma from a table by intensity (SyB3R)"
    example: ClassVar = {"sigma": [0.01, 0.08, 0.03], "correlation": [0.6, -0.3, 0.5]}

    sigma: Sigmas | Annotated[tuple[Sigmas, Sigmas, Sigmas], Field(strict=False)] | None = (
        parameter(
            None,
            "Standard deviations at intensities evenly spaced from 0 to 1, with linear "
            "interpolation: one list, or one each for red, green and blue.",
            "of full scale",
            "as measured",
        )
    )

    def resolve(self, context: Context) -> "IntensityDependent":
        correlated = self.with_correlation(context.iso)
        if self.sigma is not None:
            return correlated
        intensities = np.linspace(0, 1, RESOLVED_SIZE)
        curves = (np.interp(intensities, *c).clip(0, 1) for c in self.noise(context.iso).curves)
        sigma = tuple(tuple(curve.round(6).tolist()) for curve in curves)
        return correlated.with_defaults(sigma=sigma)

    def table(self) -> Floats:
        """Return sigma at the 256 intensities v = i / 255 of red, of green and of blue, (768,)."""
        assert self.sigma is not None
        return _table(self.sigma)

    def passes(self) -> tuple[Pass, ...]:
        names = ("sigmas", *MIXING_NAMES)
        return (Pass("picture_noise", arguments=names, random=NoiseScope.IMAGE),)

    def arguments(self, context: Context) -> Arguments:
        return {"sigmas": self.table(), **self.mixing_arguments()}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        index = to_8_bit(image) + np.arange(3) * TABLE_SIZE
        return image + self.normals(image, inputs) * self.table()[index]


@lru_cache(maxsize=16)
def _table(sigma: tuple[Any, ...]) -> Floats:
    intensities = np.linspace(0, 1, TABLE_SIZE)
    curves = sigma if isinstance(sigma[0], tuple) else (sigma,) * 3
    sampled = [np.interp(intensities, np.linspace(0, 1, len(curve)), curve) for curve in curves]
    return np.concatenate(sampled).astype(np.float32)


class MeasuredNoise(NamedTuple):
    """Measured noise of red, green and blue, in display values, 0..1.

    ``sigma`` covers all samples. A curve contains ascending intensities and the sigma at each.
    ``correlation`` lists red with green, red with blue, and green with blue.
    """

    sigma: tuple[float, ...]
    curves: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]
    correlation: tuple[float, ...]


def measured_noise(path: str) -> Mapping[float | None, Mapping[str, MeasuredNoise]]:
    """Return the noise in a report of ``clpipe measure --json``, by ISO and kind of matching.

    The ISO is None if the report has only one, or does not state it.

    The noise of "halved" has the measured variance after averaging 2x2 pixels. This averaging
    leaves a quarter of the variance of independent noise.

    A changed file is read again.

    Raises:
        ValueError: the file cannot be read, is not such a report, or is not on display values.
    """
    try:
        return _measured_noise(path)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from None


@cached_by_mtime
def _measured_noise(path: str) -> Mapping[float | None, Mapping[str, MeasuredNoise]]:
    try:
        report = parse_json(read_bytes(Path(path)))
        reports = report.get("by_iso", {UNKNOWN: report})
        kinds = {each["kind"] for each in reports.values()} or {report["kind"]}
        kind = ", ".join(kinds)
        if kinds == {Kind.DISPLAY.label}:
            return {
                None if iso == UNKNOWN else float(iso): {
                    "picture": _noise_of(each, "picture", "intensity_picture"),
                    "flat": _noise_of(each, "flat", "intensity"),
                    "halved": _noise_of(each, "halved", "intensity_picture", averaged=4),
                }
                for iso, each in reports.items()
            }
    except (ValueError, OverflowError, LookupError, TypeError, AttributeError):
        raise ValueError("not a report of clpipe measure --json") from None
    raise ValueError(
        f"this report measures {kind} images, but picture_noise needs finished images (JPEG, PNG, "
        "or EXR kept after gamma); run clpipe measure --json on those"
    )


def _noise_of(report: Any, area: str, curve: str, averaged: int = 1) -> MeasuredNoise:
    """Return the noise in one area of a report, after averaging this number of pixels.

    The curves are scaled to the sigma there. Rounding is not included, because the noisy image will
    be rounded again.
    """
    covariance = np.array(report["covariance"][area], float)
    variance = np.diag(covariance)
    are_variances = ((variance >= 0) & (variance <= 1)).all() and np.isfinite(covariance).all()
    if covariance.shape != (3, 3) or not are_variances:
        raise TypeError
    sigma = np.sqrt(variance)
    divisor = np.where(sigma > 0, sigma, 1)
    correlation = (covariance / np.outer(divisor, divisor)).clip(-1, 1)
    pairs = tuple(correlation[[0, 0, 1], [1, 2, 2]].tolist())
    mixing(*pairs)
    rounding = float(report["rounding_variance"])
    if not 0 <= rounding <= 1:
        raise TypeError
    sigmas = tuple(np.sqrt((averaged * variance - rounding).clip(0, 1)).tolist())
    records = (report["channels"][name][curve] for name in CHANNELS)
    curves = tuple(_curve_of(each, s) for each, s in zip(records, sigmas, strict=True))
    return MeasuredNoise(sigmas, curves, pairs)


def _curve_of(record: Any, target_sigma: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return a curve of a report, scaled so that all of its samples together have one sigma."""
    mean, sigma, samples = (np.array(record[key], float) for key in ("mean", "sigma", "samples"))
    are_noise = ((sigma >= 0) & (sigma <= 1) & (samples > 0)).all()
    is_curve = mean.shape == sigma.shape == samples.shape == (mean.size,) and mean.size > 0
    if not (is_curve and are_noise and np.isfinite(mean).all()):
        raise TypeError
    overall_sigma = np.sqrt(np.average(sigma**2, weights=samples))
    return tuple(mean.tolist()), tuple(
        (sigma * (target_sigma / overall_sigma if overall_sigma else 0)).tolist()
    )


STAGE = Stage(
    "picture_noise",
    "Add noise to the finished image, as a baseline.",
    Kind.DISPLAY,
    Kind.DISPLAY,
    (NoNoise, IidGaussian, IntensityDependent),
    role=StageRole.BASELINE,
)
