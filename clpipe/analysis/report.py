"""The report of a measurement: statistics of all channels, and its JSON form."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from clpipe.analysis.intensity import NOT_IN_JSON
from clpipe.analysis.statistics import HISTOGRAM, SIGMAS, Channel, gaussian_beyond
from clpipe.base.types import Doubles

# The unit of intensities and sigmas, for each kind of image.
UNITS = {
    "display": "of full scale, display values",
    "rgb": "RGB before gamma",
    "mosaic": "signal: 0 = black level, 1 = white level",
    "values": "as in the file",
}


@dataclass(frozen=True, kw_only=True)
class NoiseReport:
    """The measured noise of some images, channel by channel."""

    kind: str
    iso: float | None = None  # None if the images do not state it
    bursts: int = 1  # number of bursts whose noise is pooled
    rounding_variance: float = 0.0  # that rounding in files adds to each channel
    images: tuple[str, ...]
    truth: str | None  # None: the mean of the images
    width: int
    height: int
    share_used: float  # share of valid pixels, or of valid samples in a mosaic
    notes: tuple[str, ...]
    channels: tuple[Channel, ...]
    # RMS of luma noise at edges relative to flat areas; only for pictures.
    edges_over_flat: float = math.nan
    finished: Mapping[str, float] = field(default_factory=dict)  # see clpipe.analysis.finished
    covariance: Mapping[str, Doubles]  # RGB covariance matrices, (3, 3), by area; {} for mosaics
    correlation: Mapping[str, float]  # of two channels, such as "R-G"
    frames: int = 0  # the number of frames of a clip; 0 for images
    # The correlation with frames 1, 2 and more later, by channel; only for clips.
    temporal_correlation: Mapping[str, Doubles] = field(default_factory=dict)
    edges: Doubles = field(metadata=NOT_IN_JSON)  # edges of the intensity bins

    def record(self) -> dict[str, Any]:
        """Return the report as JSON values; unknown values are null."""
        channels = {channel.name: channel_record(channel) for channel in self.channels}
        return (
            {"kind": self.kind, "unit": UNITS[self.kind]}
            | json_value(self)
            | {"channels": channels}
        )


def json_value(value: Any) -> Any:
    """Return a value for JSON: data classes as objects, arrays as lists, and NaN as null.

    Fields with the metadata NOT_IN_JSON are omitted.

    >>> json_value({"a": np.array([1.5, np.nan]), "b": (1, None)})
    {'a': [1.5, None], 'b': [1, None]}
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if is_dataclass(value):
        names = (each.name for each in fields(value) if each.metadata != NOT_IN_JSON)
        value = {name: getattr(value, name) for name in names}
    if isinstance(value, Mapping):
        return {str(key): json_value(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def json_object(**values: Any) -> dict[str, Any]:
    """Return values by name as a JSON object, see :func:`json_value`."""
    return {name: json_value(value) for name, value in values.items()}


def channel_record(channel: Channel) -> dict[str, Any]:
    """Return a channel as JSON values."""
    tails, found = channel.tails, json_value(channel)
    return found | json_object(
        skewness=tails.skewness,
        excess_kurtosis=tails.excess_kurtosis,
        beyond=dict(zip(SIGMAS, tails.beyond, strict=True)),
        gaussian_beyond={k: gaussian_beyond(k) for k in SIGMAS},
        histogram={"edges": HISTOGRAM.round(2), "samples": tails.histogram},
    )
