"""The report of a measurement: statistics of all channels, and its JSON form."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from clpipe.analysis.intensity import NoiseCurve
from clpipe.analysis.spatial import LineNoise
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
        return {
            "kind": self.kind,
            "unit": UNITS[self.kind],
            "iso": self.iso,
            "bursts": self.bursts,
            "rounding_variance": self.rounding,
            "images": list(self.images),
            "truth": self.truth,
            "width": self.width,
            "height": self.height,
            "share_used": self.share,
            "notes": list(self.notes),
            "channels": {channel.name: channel_record(channel) for channel in self.channels},
            "edges_over_flat": json_number(self.at_edges),
            "finished": {name: json_number(value) for name, value in self.finished.items()},
            "covariance": {where: table.tolist() for where, table in self.covariances.items()},
            "correlation": {f"{a}-{b}": json_number(r) for (a, b), r in self.correlations.items()},
            "frames": self.frames,
            "temporal_correlation": {
                name: list(map(json_number, values)) for name, values in self.temporal.items()
            },
        }


def json_number(value: float) -> float | None:
    """Return a number for JSON, in which NaN becomes null."""
    return None if math.isnan(value) else float(value)


def line_record(lines: LineNoise) -> dict[str, float | None]:
    """Row or column noise as JSON values."""
    return {name: json_number(value) for name, value in asdict(lines).items()}


def curve_record(curve: NoiseCurve) -> dict[str, list[float]]:
    """Noise by intensity as JSON values."""
    return {
        "mean": curve.mean.tolist(),
        "sigma": curve.sigma.tolist(),
        "shift": curve.shift.tolist(),
        "samples": curve.count.tolist(),
    }


def channel_record(channel: Channel) -> dict[str, Any]:
    """Return a channel as JSON values."""
    law, tails = channel.law, channel.tails
    whole = channel.whole_curve
    return {
        "samples": channel.count,
        "sigma": channel.sigma,
        "sigma_picture": channel.whole_sigma,
        "law": law and asdict(law),
        "intensity": curve_record(channel.curve),
        "intensity_picture": whole and curve_record(whole),
        "row": line_record(channel.rows),
        "column": line_record(channel.columns),
        "autocorrelation": [
            [json_number(r) for r in row] for row in channel.autocorrelation.tolist()
        ],
        "energy_left_2x2": json_number(channel.energy_left),
        "skewness": json_number(tails.skewness),
        "excess_kurtosis": json_number(tails.excess_kurtosis),
        "beyond": {str(k): json_number(p) for k, p in zip(SIGMAS, tails.beyond, strict=True)},
        "gaussian_beyond": {str(k): gaussian_beyond(k) for k in SIGMAS},
        "histogram": {"edges": HISTOGRAM.round(2).tolist(), "samples": tails.histogram.tolist()},
    }
