"""Dark shading: smooth maps that a sensor adds to every frame, even without light."""

from math import sqrt
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import field_validator

from clpipe.base.errors import ImageError
from clpipe.base.reading import cached_by_mtime, read_errors
from clpipe.base.types import Array, Floats
from clpipe.reference.random import Stream, normal_of, philox
from clpipe.stage import (
    Arguments,
    Backend,
    CompileTime,
    Context,
    LineTable,
    Method,
    NoiseScope,
    Numbers,
    Pass,
    Signal,
    SignalMethod,
    camera_parameter,
    parameter,
    sensor_stage,
)

# Each product multiplies a curve over the rows by a curve over the columns. Each of the two maps
# has two products.
PRODUCTS = 4


def curve(count: int, number: int, per_px: np.float32, stream: Stream) -> Floats:
    """Return a smooth random curve of variance 1, (count,): a cubic B-spline of standard normals.

    Args:
        count: number of rows or columns.
        number: number of the curve in the stream.
        per_px: knots per row or column.
        stream: the source of the normals.
    """
    t = np.arange(count, dtype=np.float32) * per_px
    whole = t.astype(np.int32)
    f = t - whole.astype(np.float32)
    f2 = f * f
    f3, g = f2 * f, np.float32(1) - f
    one, three, four, six = map(np.float32, (1, 3, 4, 6))
    weights = (
        g * g * g,
        three * f3 - six * f2 + four,
        three * f2 + three * f - three * f3 + one,
        f3,
    )
    total = np.zeros(count, np.float32)
    for k, weight in enumerate(weights):
        knot = (whole + k).astype(np.uint32)
        total = total + normal_of(philox(knot, 0, number, stream.stage, stream)[0]) * weight
    return np.asarray(total * np.float32(0.24078))


class Smooth(SignalMethod):
    """y + ISO * k(x, y) + b(x, y): two smooth maps, fixed for a camera.

    Feng et al., "Learnability enhancement for low-light raw image denoising: A data perspective"
    (PMN; TPAMI 2023), find that dark shading is linear in the ISO. The maps here are random and
    depend only on the camera and the sensor's seed. Each map is the sum of two products of a curve
    over the rows and a curve over the columns. The curves are cubic B-splines with a knot every
    ``length`` pixels.

    >>> from clpipe.stage import run_reference
    >>> shaded = run_reference(Smooth(offset=0.01, length=100.0), np.zeros((900, 900), np.float32))
    >>> steps = np.diff(shaded, axis=0)
    >>> 0.004 < float(shaded.std()) < 0.02, float(abs(steps).max()) < 0.002
    (True, True)
    """

    method: ClassVar = "smooth"
    kernel: ClassVar = "dark_shading"
    summary: ClassVar = (
        "add two smooth random maps of the camera, one of them proportional to the ISO"
    )
    example: ClassVar = {"slope": 1e-5, "offset": 0.01, "length": 7.3}

    slope: float | None = camera_parameter(
        "Standard deviation of the map k.", "signal per ISO", ge=0, le=1
    )
    offset: float | None = camera_parameter(
        "Standard deviation of the map b.", "signal", ge=0, le=1
    )
    length: float | None = camera_parameter(
        "Distance between the knots of the maps.", "px", ge=4, le=1e5
    )

    def resolve(self, context: Context) -> "Smooth":
        camera = context.camera
        unit = camera.signal_range
        return self.with_defaults(
            slope=camera.dark_shading_slope / unit,
            offset=camera.dark_shading_offset / unit,
            length=camera.dark_shading_length,
        )

    def passes(self) -> tuple[Pass, ...]:
        if not self.slope and not self.offset:
            return ()
        tables = [f"{axis}_{k}" for k in range(PRODUCTS) for axis in ("rows", "columns")]
        return (
            *(
                Pass(
                    "curve_of_lines",
                    LineTable("rows" if table.startswith("rows") else "columns"),
                    (f"curve_{number}", "per_px"),
                    writes=table,
                    random=NoiseScope.CAMERA,
                )
                for number, table in enumerate(tables)
            ),
            Pass("dark_shading", arguments=("slope", "offset", *tables)),
        )

    def _amplitudes(self, iso: float) -> tuple[float, float]:
        """The factors of the products in both maps that give the maps their standard deviations."""
        assert self.slope is not None and self.offset is not None
        return self.slope * iso / sqrt(2), self.offset / sqrt(2)

    @property
    def _per_px(self) -> float:
        assert self.length is not None
        return 1 / self.length

    def arguments(self, context: Context) -> Arguments:
        slope, offset = self._amplitudes(context.iso)
        numbers = {f"curve_{k}": CompileTime(f"{k}u") for k in range(2 * PRODUCTS)}
        return {**numbers, "per_px": self._per_px, "slope": slope, "offset": offset}

    def variance(self, input_variance: Floats, signal: Floats, context: Context) -> Floats:
        """The variance of the noise: a smooth map that is the same in every frame adds none."""
        return input_variance

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        of_iso = backend.fixed(shading, lambda method, _: (np.float32(method._per_px), 0))
        fixed = backend.fixed(shading, lambda method, _: (np.float32(method._per_px), PRODUCTS))
        return y + (of_iso * n["slope"] + fixed * n["offset"])


def shading(height: int, width: int, stream: Stream, per_px: np.float32, first: int) -> Floats:
    """Return the sum of two products of a curve over the rows and one over the columns."""
    down, across, other_down, other_across = (
        curve(width if k % 2 else height, first + k, per_px, stream) for k in range(4)
    )
    return down[:, None] * across + other_down[:, None] * other_across


def read_map(path: str) -> Floats:
    """Return the map in a file of one channel, (height, width), DN. A changed file is read again.

    Raises:
        ValueError: the file cannot be read, or does not contain such a map.
    """
    try:
        with read_errors(path):
            return _read_map(path)
    except ImageError as error:
        raise ValueError(str(error)) from None


@cached_by_mtime
def _read_map(path: str) -> Floats:
    from clpipe.images.read import read_image  # this import is slow and rarely needed

    return np.asarray(read_image(Path(path), mosaic=True).pixels, np.float32)


def combine_maps(slope: str | None, offset: str | None, iso: float, unit: float) -> Floats:
    """Return the map ISO * k + b, in signal units, from two files, one of which may be absent.

    Raises:
        ValueError: the two maps differ in size.
    """
    maps = [read_map(path) for path in (slope, offset) if path]
    if len({each.shape for each in maps}) > 1:
        sizes = " and ".join(f"{w}x{h}" for h, w in (each.shape for each in maps))
        raise ValueError(f"slope_file and offset_file differ in size: {sizes}")
    factors = [factor for path, factor in ((slope, iso), (offset, 1.0)) if path]
    total = sum(each * factor for each, factor in zip(maps, factors, strict=True))
    return np.asarray(total / unit, np.float32)


class File(SignalMethod):
    """y + ISO * k(x, y) + b(x, y): measured maps of a sensor, from files.

    Each file is an image of one channel (EXR or TIFF of floats) in DN, for example of means over
    blocks. Its samples are ``block`` pixels apart. Values between them are interpolated linearly,
    and pixels outside take the value of the nearest sample.
    """

    method: ClassVar = "file"
    kernel: ClassVar = "dark_shading_file"
    summary: ClassVar = "add measured maps of a sensor, one of them proportional to the ISO"

    slope_file: str | None = parameter(
        None, "Image of the map k, in DN per ISO.", "", "none", file=True
    )
    offset_file: str | None = parameter(None, "Image of the map b, in DN.", "", "none", file=True)
    block: float = parameter(32.0, "Distance between the samples of the maps.", "px", ge=1, le=4096)
    unit: float | None = camera_parameter(
        "DN that correspond to a signal of 1.", "DN", gt=0, le=1e6
    )

    @field_validator("slope_file", "offset_file")
    @classmethod
    def _check_file(cls, path: str | None) -> str | None:
        if path is not None:
            read_map(path)
        return path

    def resolve(self, context: Context) -> "File":
        resolved = self.with_defaults(unit=context.camera.signal_range)
        combine_maps(resolved.slope_file, resolved.offset_file, context.iso, resolved.unit or 1.0)
        return resolved

    def passes(self) -> tuple[Pass, ...]:
        if not self.slope_file and not self.offset_file:
            return ()
        return (Pass("dark_shading_file", arguments=("map", "width", "height", "per_px")),)

    def _map(self, iso: float) -> Floats:
        return combine_maps(self.slope_file, self.offset_file, iso, self.unit or 1.0)

    def arguments(self, context: Context) -> Arguments:
        if not self.passes():
            return {}
        shading_map = self._map(context.iso)
        height, width = shading_map.shape
        return {"map": shading_map, "width": width, "height": height, "per_px": 1 / self.block}

    def without_noise(self) -> Method | None:
        return None if self.passes() else self

    @classmethod
    def apply(cls, y: Signal, n: Numbers, backend: Backend) -> Signal:
        return y + backend.fixed(map_at_iso, lambda method, context: (method, context.iso))

    def at_iso(self, height: int, width: int, iso: float) -> Floats:
        """Return the map that is added, (height, width), in signal units."""
        shading_map = self._map(iso)
        (up, down, v), (left, right, x) = (
            sample_positions(n, np.float32(1 / self.block), count)
            for n, count in zip((height, width), shading_map.shape, strict=True)
        )
        rows = [
            shading_map[row][:, left] + (shading_map[row][:, right] - shading_map[row][:, left]) * x
            for row in (up, down)
        ]
        upper, lower = rows
        total: Floats = upper + (lower - upper) * v[:, None]
        return total


def map_at_iso(height: int, width: int, stream: Stream, method: File, iso: float) -> Floats:
    """Return the map that a method adds, (height, width), in signal units. It is not random."""
    return method.at_iso(height, width, iso)


def sample_positions(pixels: int, per_px: np.float32, count: int) -> tuple[Array, Array, Floats]:
    """Return, for each pixel of a row, its left and right sample and the weight of the right one.

    Args:
        pixels: pixels of the row.
        per_px: samples per pixel.
        count: samples of the row.
    """
    half, zero = np.float32(0.5), np.float32(0)
    t = (np.arange(pixels, dtype=np.float32) + half) * per_px - half
    t = np.minimum(np.maximum(t, zero), np.float32(count - 1))
    first = t.astype(np.int32)
    return first, np.minimum(first + 1, count - 1), t - first.astype(np.float32)


STAGE = sensor_stage("dark_shading", "Add smooth dark shading maps of the sensor.", (Smooth, File))
