"""The report of a measurement: statistics of all channels, and its JSON form."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from clpipe.analysis.intensity import NoiseCurve
from clpipe.analysis.statistics import HISTOGRAM, SIGMAS, Channel, gaussian_beyond
from clpipe.base.types import Doubles

# The unit of intensities and sigmas, for each kind of image.
UNITS = {
    "display": "of full scale, display values",
    "rgb": "RGB before gamma",
    "mosaic": "signal: 0 = black level, 1 = white level",
    "values": "as in the file",
}


@dataclass(frozen=True)
class NoiseReport:
    """The measured noise of some images, channel by channel."""

    kind: str
    images: tuple[str, ...]
    truth: str | None  # None: the mean of the images
    width: int
    height: int
    share: float  # share of valid pixels, or of valid samples in a mosaic
    edges: Doubles  # edges of the intensity bins
    channels: tuple[Channel, ...]
    correlations: Mapping[tuple[str, str], float]
    covariances: Mapping[str, Doubles]  # RGB covariance matrices, (3, 3), by area; {} for mosaics
    notes: tuple[str, ...]
    iso: float | None = None  # None if the images do not state it
    bursts: int = 1  # number of bursts whose noise is pooled
    # RMS of luma noise at edges relative to flat areas; only for pictures.
    at_edges: float = math.nan
    finished: Mapping[str, float] = field(default_factory=dict)  # see clpipe.analysis.finished
    rounding: float = 0.0  # the variance that rounding in files adds to each channel
    frames: int = 0  # the number of frames of a clip; 0 for images
    # The correlation with frames 1, 2 and more later, by channel; only for clips.
    temporal: Mapping[str, Doubles] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """Return the report as JSON values; unknown values are null."""
        return json_object(
            kind=self.kind,
            unit=UNITS[self.kind],
            iso=self.iso,
            bursts=self.bursts,
            rounding_variance=self.rounding,
            images=self.images,
            truth=self.truth,
            width=self.width,
            height=self.height,
            share_used=self.share,
            notes=self.notes,
            channels={channel.name: channel_record(channel) for channel in self.channels},
            edges_over_flat=self.at_edges,
            finished=self.finished,
            covariance=self.covariances,
            correlation={f"{a}-{b}": r for (a, b), r in self.correlations.items()},
            frames=self.frames,
            temporal_correlation=self.temporal,
        )


def json_value(value: Any) -> Any:
    """Return a value for JSON: data classes as objects, arrays as lists, and NaN as null.

    >>> json_value({"a": np.array([1.5, np.nan]), "b": (1, None)})
    {'a': [1.5, None], 'b': [1, None]}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_value(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def json_object(**values: Any) -> dict[str, Any]:
    """Return values by name as a JSON object, see :func:`json_value`."""
    return {name: json_value(value) for name, value in values.items()}


def curve_record(curve: NoiseCurve | None) -> dict[str, Any] | None:
    """Noise by intensity as JSON values."""
    return (
        None
        if curve is None
        else json_object(mean=curve.mean, sigma=curve.sigma, shift=curve.shift, samples=curve.count)
    )


def channel_record(channel: Channel) -> dict[str, Any]:
    """Return a channel as JSON values."""
    tails = channel.tails
    return json_object(
        samples=channel.count,
        sigma=channel.sigma,
        sigma_picture=channel.whole_sigma,
        law=channel.law,
        intensity=curve_record(channel.curve),
        intensity_picture=curve_record(channel.whole_curve),
        row=channel.rows,
        column=channel.columns,
        autocorrelation=channel.autocorrelation,
        energy_left_2x2=channel.energy_left,
        skewness=tails.skewness,
        excess_kurtosis=tails.excess_kurtosis,
        beyond=dict(zip(SIGMAS, tails.beyond, strict=True)),
        gaussian_beyond={k: gaussian_beyond(k) for k in SIGMAS},
        histogram={"edges": HISTOGRAM.round(2), "samples": tails.histogram},
    )
