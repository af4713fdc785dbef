"""Temporal correlation of the noise of a clip that shows a static scene."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from clpipe.analysis.measure import NoiseOf, report_of
from clpipe.analysis.pictures import Picture
from clpipe.analysis.report import NoiseReport
from clpipe.base.errors import RequestError
from clpipe.base.types import Doubles, Floats, Mask
from clpipe.images.video_reading import read_video, video_info
from clpipe.outputs.noise_areas import select_flat
from clpipe.reference.colour import rgb_to_ycbcr
from clpipe.stage import Kind

MAX_FRAMES = 64
MAX_PIXELS = 6_000_000  # of all frames together, which take 1 GB to measure
LAGS = 3  # the most frames between correlated samples


def load_frames(path: Path) -> list[Picture]:
    """Return the first :data:`MAX_FRAMES` frames of a clip, cropped to :data:`MAX_PIXELS`.

    The crop is the middle of each frame.

    Raises:
        RequestError: PyAV is missing, or the clip has a single frame.
        ImageError: the clip cannot be read.
    """
    info = video_info(path)
    count = max(min(info.frames, MAX_FRAMES), 1)
    scale = min((MAX_PIXELS / (count * info.width * info.height)) ** 0.5, 1)
    width, height = int(info.width * scale), int(info.height * scale)
    left, top = (info.width - width) // 2, (info.height - height) // 2
    step = 1 / (2**info.bits - 1)
    pictures = []
    for number, frame in enumerate(islice(read_video(path), MAX_FRAMES)):
        crop = frame[top : top + height, left : left + width]
        pixels = crop * np.float32(1 / np.iinfo(frame.dtype).max)
        name = Path(f"{path}, frame {number},")  # for messages
        pictures.append(Picture(name, "display", pixels, "", 0.0, 1.0, step=step, is_coded=True))
    if len(pictures) < 2:
        raise RequestError(f"{path}: this clip has one frame; give a clip of several frames")
    return pictures


def measure_clip(path: Path) -> NoiseReport:
    """Measure the noise of a clip of a static scene, against the mean of its frames.

    In addition to :func:`clpipe.analysis.measure.measure`, the report has the temporal correlation
    of flat areas, see :func:`temporal_correlation`.

    Raises:
        RequestError: PyAV is missing, or the frames are not repeats of one scene.
        ImageError: the clip cannot be read, or has no valid pixels.
    """
    pictures = load_frames(path)
    measured = NoiseOf.images(pictures, None)
    report = report_of(pictures, None, measured)
    usable: Mask = ~measured.clipped.any(axis=(0, -1))  # type: ignore[assignment]
    noise = measured.noise
    flat = select_flat(measured.clean, noise, usable)
    planes = np.concatenate([noise, rgb_to_ycbcr(noise)], axis=-1)[:, flat]
    names = (*Kind.RGB.channels, *Kind.YCBCR.channels)
    temporal = {name: temporal_correlation(planes[..., c]) for c, name in enumerate(names)}
    return replace(report, images=(str(path),), frames=len(pictures), temporal_correlation=temporal)


def temporal_correlation(noise: Floats, lags: int = LAGS) -> Doubles:
    """Return the correlation of noise with that of 1, 2 and more frames later.

    The mean of n frames, which is removed, contains noise. The means of the products at each lag
    are therefore too small, by about 1 / n of the variance for independent noise, and by more for
    correlated noise. They are linear functions of the true covariances, so this function solves the
    linear equations. It assumes no correlation at lags of n / 2 and more.

    Args:
        noise: (frame, sample), differences from the mean of the frames.
        lags: the most lags. There are fewer than half as many as frames.

    Returns:
        Correlations at the lags 1, 2 and so on. They are NaN without noise.

    >>> rng = np.random.default_rng(0)
    >>> noise = rng.normal(size=(8, 100_000)).astype(np.float32)
    >>> bool(abs(temporal_correlation(noise - noise.mean(0))).max() < 0.01)
    True
    """
    count = len(noise)
    most = (count - 1) // 2
    products = noise @ noise.T / np.float32(noise.shape[1])
    measured = np.array([np.diagonal(products, k).mean(dtype=np.float64) for k in range(most + 1)])
    removal = np.eye(count) - 1 / count
    distance = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    table = np.empty((most + 1, most + 1))
    for k in range(most + 1):
        covariance = removal @ (distance == k) @ removal
        table[:, k] = [np.diagonal(covariance, j).mean() for j in range(most + 1)]
    true = np.linalg.solve(table, measured)
    with np.errstate(invalid="ignore"):
        return true[1 : lags + 1] / true[0]
