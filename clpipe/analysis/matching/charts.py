"""Makes a development as sharp and as bright as pictures of charts by the same camera."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.analysis.matching.space import TONE
from clpipe.analysis.quality.charts import GREYS, checker, patch_image, patches_of
from clpipe.analysis.quality.checker import find_checker
from clpipe.analysis.quality.measure import light_of
from clpipe.analysis.quality.photographs import NOTHING, read_levels
from clpipe.analysis.sharpness import Edge, edge_of, edges_in, median_edge, sharpest
from clpipe.base.errors import ImageError
from clpipe.base.types import Doubles
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.device import Device
from clpipe.engine.service import Frame, Service
from clpipe.reference.colour import luma

FIRST = (1.0, 0.78, 0.72)  # exposure, toe and shoulder from which the fit starts
LIMITS = ((0.1, 0.0, 0.05), (10.0, 1.0, 1.0))


@dataclass(frozen=True)
class Tone:
    """The luma of the grey patches of a ColorChecker, from white to black, 0 to 255."""

    theirs: tuple[float, ...]
    ours: tuple[float, ...]

    def __str__(self) -> str:
        worst = max(abs(a - b) for a, b in zip(self.theirs, self.ours, strict=True))
        return f"tone: the greys of the chart are met within {worst:.1f} levels of 255"


@dataclass(frozen=True, eq=False)
class Charts:
    """What pictures of charts show: the sharpness of edges, and the luma of greys, if any."""

    edge: Edge | None = None
    greys: Doubles | None = None


def read_charts(paths: Sequence[Path]) -> Charts:
    """Return what pictures show: a slanted edge that fills them, edges anywhere, a ColorChecker.

    Raises:
        ImageError: a picture cannot be read, or shows none of them.
    """
    edges: list[Edge] = []
    greys = None
    for path in paths:
        levels, _ = read_levels(path)
        whole = edge_of(light_of(levels), strict=True)
        patches = None if whole else find_checker(levels)
        found = whole or sharpest(edges_in(levels))
        if patches is None and found is None:
            raise ImageError(f"{path}: {NOTHING}")
        edges += [found] if found else []
        greys = greys if patches is None else luma(patches[GREYS].mean((1, 2)))
    return Charts(median_edge(edges) if edges else None, greys)


def as_toned(settings: Settings, greys: Doubles, device: Device | None) -> tuple[Settings, Tone]:
    """Return settings whose tone curve gives the greys of a ColorChecker, and the luma of both.

    Toe and shoulder of the standard curve are fitted, and the exposure of the chart, which is not
    part of the result.

    Args:
        settings: of the development.
        greys: luma of the grey patches, from white to black.
        device: the device that develops the chart; None is NumPy.
    """
    from scipy.optimize import least_squares

    service, render = Service([device]), patch_image(checker()[GREYS])

    def over(toe: float, shoulder: float) -> dict[str, Any]:
        return {TONE: {"method": "standard", "toe": round(toe, 3), "shoulder": round(shoulder, 3)}}

    def ours(values: Doubles) -> Doubles:
        exposure, *curve = map(float, values)
        chain = make_chain(overlay(settings, over(*curve))).without_noise()
        frame = Frame(chain, render * np.float32(exposure), "chart", encode=False, final=True)
        developed = 255 * service.run(frame).image  # levels between the whole ones
        return np.asarray(
            luma(patches_of(developed[None])[: len(greys)].mean((1, 2, 3))), np.float64
        )

    found = least_squares(
        lambda values: ours(values) - greys, FIRST, bounds=LIMITS, diff_step=0.02, x_scale=0.2
    ).x
    tone = Tone(tuple(greys.tolist()), tuple(ours(found).tolist()))
    return overlay(settings, over(*map(float, found[1:]))), tone
