"""Demosaicing: three colours at every pixel from one."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from clpipe.reference.cfa import Pattern, by_site
from clpipe.reference.image import tap
from clpipe.stage import Access, Argument, Context, Frame, Kind, Method, Pass, Stage
from clpipe.types import Floats

HALF, QUARTER = np.float32(0.5), np.float32(0.25)


def neighbours(image: Floats) -> tuple[Floats, Floats, Floats]:
    """Means of the two pixels beside, of the two above and below, of the four diagonal ones."""
    horizontal = (tap(image, -1, 0) + tap(image, 1, 0)) * HALF
    vertical = (tap(image, 0, -1) + tap(image, 0, 1)) * HALF
    upper, lower = tap(image, -1, -1) + tap(image, 1, -1), tap(image, -1, 1) + tap(image, 1, 1)
    return horizontal, vertical, (upper + lower) * QUARTER


def in_red_row(image: Floats, pattern: Pattern) -> np.ndarray:
    """Whether a pixel's row holds red sites, (height, 1)."""
    row = 0 if "R" in pattern[:2] else 1
    return (np.arange(image.shape[0])[:, None] & 1) == row


class Bilinear(Method):
    """A missing colour is the mean of its nearest samples."""

    method: ClassVar = "bilinear"
    kernel: ClassVar = "demosaic_bilinear"
    summary: ClassVar = "mean of the nearest samples of each colour"

    def passes(self) -> tuple[Pass, ...]:
        return (Pass("bilinear", Access.STENCIL, ("pattern",), radius=1),)

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"pattern": context.cfa}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        pattern = frame.context.pattern
        horizontal, vertical, diagonal = neighbours(image)
        cross = (horizontal + vertical) * HALF
        red_row = in_red_row(image, pattern)
        beside_red = np.where(red_row, horizontal, vertical)
        beside_blue = np.where(red_row, vertical, horizontal)
        red = by_site(image.shape, pattern, image, beside_red, diagonal)
        green = by_site(image.shape, pattern, cross, image, cross)
        blue = by_site(image.shape, pattern, diagonal, beside_blue, image)
        return np.stack([red, green, blue], axis=-1)


class EdgeDirectedMedian(Method):
    """Edge-directed green (Hamilton and Adams, US patent 5,629,734, 1997), then Freeman's median.

    Red and blue follow from green by bilinear colour differences, which are then median filtered
    (Freeman, US patent 4,724,395, 1988); the samples that the sensor took are kept.
    """

    method: ClassVar = "edge_directed_median"
    kernel: ClassVar = "demosaic_edge_directed_median"
    summary: ClassVar = "green along edges (Hamilton-Adams), colour differences median filtered"

    def passes(self) -> tuple[Pass, ...]:
        return (
            Pass(
                "green_or_difference",
                Access.STENCIL,
                ("pattern",),
                writes="known",
                kind=Kind.MOSAIC,
                radius=2,
            ),
            Pass(
                "spread_differences",
                Access.STENCIL,
                ("pattern",),
                reads=("known",),
                writes="spread",
                kind=Kind.DIFFERENCES,
                radius=1,
            ),
            Pass("freeman", Access.STENCIL, ("pattern",), reads=("src", "spread"), radius=1),
        )

    def arguments(self, context: Context) -> Mapping[str, Argument]:
        return {"pattern": context.cfa}

    def reference(self, image: Floats, frame: Frame) -> Floats:
        pattern = frame.context.pattern
        west, east, north, south = (
            tap(image, dx, dy) for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1))
        )
        bend_x = np.float32(2) * image - tap(image, -2, 0) - tap(image, 2, 0)
        bend_y = np.float32(2) * image - tap(image, 0, -2) - tap(image, 0, 2)
        gradient_x = abs(west - east) + abs(bend_x)
        gradient_y = abs(north - south) + abs(bend_y)
        green_x = (west + east) * HALF + bend_x * QUARTER
        green_y = (north + south) * HALF + bend_y * QUARTER
        either = (green_x + green_y) * HALF
        along = np.where(gradient_y < gradient_x, green_y, either)
        green = np.where(gradient_x < gradient_y, green_x, along)
        known = by_site(image.shape, pattern, image - green, image, image - green)

        horizontal, vertical, diagonal = neighbours(known)
        red_row = in_red_row(image, pattern)
        beside_red = np.where(red_row, horizontal, vertical)
        beside_blue = np.where(red_row, vertical, horizontal)
        red_difference = median3(by_site(image.shape, pattern, known, beside_red, diagonal))
        blue_difference = median3(by_site(image.shape, pattern, diagonal, beside_blue, known))

        green = by_site(
            image.shape, pattern, image - red_difference, image, image - blue_difference
        )
        red, blue = green + red_difference, green + blue_difference
        red = by_site(image.shape, pattern, image, red, red)
        blue = by_site(image.shape, pattern, blue, blue, image)
        return np.stack([red, green, blue], axis=-1)


def median3(image: Floats) -> Floats:
    """Median of the 3x3 pixels around each pixel."""
    around = [tap(image, dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return np.median(np.stack(around), axis=0).astype(np.float32)


STAGE = Stage(
    "demosaic",
    "Give every pixel its two missing colours.",
    Kind.MOSAIC,
    Kind.RGB,
    (EdgeDirectedMedian, Bilinear),
)
