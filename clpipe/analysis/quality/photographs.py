"""Measures pictures of real charts, which are found in them or in named areas."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from clpipe.analysis.crops import choose_crops
from clpipe.analysis.quality import lens
from clpipe.analysis.quality.charts import CHECKER, GREYS
from clpipe.analysis.quality.checker import find_checker
from clpipe.analysis.quality.colour import checker_errors
from clpipe.analysis.quality.greys import GreyPatches
from clpipe.analysis.quality.measure import (
    Found,
    edge_found,
    grey_figures,
    light_of,
    texture_found,
)
from clpipe.analysis.quality.report import MAIN, Quality
from clpipe.analysis.quality.texture import printed_texture_mtf
from clpipe.analysis.sharpness import LUMINANCE, edge_of, edges_in, median_edge, sharpest
from clpipe.base.errors import ImageError, RequestError
from clpipe.base.types import Array, Doubles
from clpipe.images.read import read_finished
from clpipe.reference.curve import to_8_bit
from clpipe.reference.image import in_blocks

MEANINGS = ("black", "white", "texture", "grey")  # names of areas that no chart identifies
UNEVEN = 0.03  # of the light of a flat field, the largest rms difference from a smooth fall-off
NOTHING = (
    "no chart was found: neither a ColorChecker, a grid of dots, a flat field, nor 12 straight, "
    "isolated edges; name the area of an edge or chart (--roi X,Y,WxH)"
)


def read_levels(path: Path) -> Array:
    """Return a finished picture, (height, width, 3) uint8.

    Raises:
        ImageError: the file cannot be read, or is not a finished picture in colour.
    """
    source = read_finished(path)
    if source is None:
        raise ImageError(
            f"{path}: this is not a finished picture; give a JPEG, PNG or TIFF in colour"
        )
    return to_8_bit(source.pixels)


def picture_quality(path: Path, areas: Sequence[str] = ()) -> Quality:
    """Return what the charts of a picture show about its camera.

    Args:
        path: a finished picture.
        areas: ``[NAME=]X,Y,WxH`` in px. An area without a name has one edge or chart. "black" and
            "white" are a light trap and the white around it, for veiling glare. "texture" is a dead
            leaves chart, and "grey" an even patch next to it, whose noise is subtracted. Without
            areas, charts are sought in the whole picture.

    Raises:
        ImageError: the file cannot be read, or shows no chart.
        RequestError: an area is not valid, is outside the picture, or has no chart.
    """
    picture = read_levels(path)
    crops = choose_crops(areas, np.asarray(picture / 255, np.float32)) if areas else []
    named = {crop.name: crop.of(picture) for crop in crops if crop.name in MEANINGS}
    parts = {**_glare(named), **_texture(named)}
    edges = []
    for crop in (crop for crop in crops if crop.name not in MEANINGS):
        edge = edge_of(light_of(crop.of(picture)))
        found = {} if edge else charts_in(crop.of(picture))
        edges += [edge] if edge else []
        if not edge and not found:
            raise RequestError(
                f"{path}: --roi {crop.box}: this area has no edge, ColorChecker, grid of dots or "
                "flat field; choose one with 40 px to both sides of a straight edge"
            )
        parts |= found
    if edges:
        parts["edge"] = edge_found(median_edge(edges), MAIN)
    if not areas:
        parts = charts_in(picture)
        if edge := sharpest(edges_in(picture)):
            parts["edge"] = edge_found(edge, MAIN)
    if not parts:
        raise ImageError(f"{path}: {NOTHING}")
    figures = {key: value for own, _ in parts.values() for key, value in own.items()}
    curves = {key: value for _, own in parts.values() for key, value in own.items()}
    return Quality(path.name, figures, curves, tuple(parts))


def charts_in(picture: Array) -> dict[str, Found]:
    """Return what the charts of a picture show: a ColorChecker, a grid of dots, or a flat field."""
    light = light_of(picture)
    if (patches := find_checker(picture)) is not None:
        errors = asdict(checker_errors(patches.mean((1, 2)), np.array(CHECKER, np.float64)))
        figures, curves = grey_figures(checker_greys(patches), 1)
        return {"ColorChecker": ({**figures, **errors}, curves)}
    if (grid := lens.dot_grid(light)) is not None:
        return {"dots": (lens.dot_figures(*grid), {})}
    if is_flat(light):
        return {"flat field": (lens.shading(light), {})}
    return {}


def checker_greys(patches: Doubles) -> GreyPatches:
    """Return the grey patches of a ColorChecker, from (24, side, side, 3) levels."""
    light = light_of(np.array(CHECKER[GREYS])) @ LUMINANCE
    return GreyPatches(light[::-1], patches[GREYS][::-1, None])


def is_flat(light: Doubles) -> bool:
    """Return whether a picture shows an even surface, which may fall off smoothly.

    >>> is_flat(np.ones((64, 64, 3))), is_flat(np.eye(64)[..., None] + np.ones(3))
    (True, False)
    """
    means = in_blocks(light, max(max(light.shape[:2]) // lens.BLOCKS, 1)).mean((1, 3)) @ LUMINANCE
    y, x = (np.linspace(-1, 1, n) for n in means.shape)
    y, x = np.broadcast_arrays(y[:, None], x)
    terms = np.stack([x**i * y**j for i in range(5) for j in range(5 - i)], axis=-1)
    fitted, *_ = np.linalg.lstsq(terms.reshape(means.size, -1), means.ravel(), rcond=None)
    rest = means.ravel() - terms.reshape(means.size, -1) @ fitted
    return bool(np.sqrt(np.mean(rest**2)) < UNEVEN * means.mean())


def _glare(named: dict[str, Array]) -> dict[str, Found]:
    """Return the veiling glare of a light trap and the white around it (ISO 18844:2017)."""
    if not {"black", "white"} & named.keys():
        return {}
    if not {"black", "white"} <= named.keys():
        raise RequestError("--roi: veiling glare needs two areas, black=X,Y,WxH and white=X,Y,WxH")
    black, white = (
        float((light_of(named[name]) @ LUMINANCE).mean()) for name in ("black", "white")
    )
    return {"light trap": ({"glare": 100 * black / white}, {})}


def _texture(named: dict[str, Array]) -> dict[str, Found]:
    """Return the texture of a dead leaves chart."""
    if "texture" not in named:
        return {}
    grey = light_of(named["grey"]) if "grey" in named else None
    return {"texture": texture_found(printed_texture_mtf(light_of(named["texture"]), grey))}
