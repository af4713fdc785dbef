"""Measures pictures of real charts, which are found in them or in named areas."""

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from clpipe.analysis.crops import MANUAL, Crop
from clpipe.analysis.pictures import finished_picture
from clpipe.analysis.quality import lens
from clpipe.analysis.quality.charts import CHECKER, GREYS
from clpipe.analysis.quality.checker import find_checker
from clpipe.analysis.quality.colour import checker_errors
from clpipe.analysis.quality.greys import ROUNDING, GreyPatches
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
from clpipe.reference.curve import to_8_bit
from clpipe.reference.image import in_blocks

# The least side in px of an area: of one with an edge or chart, and of those with a name.
LEAST = {"": 40, "black": 8, "white": 8, "texture": 256, "grey": 64}
UNEVEN = 0.03  # of the light of a flat field, the largest rms difference from a smooth fall-off
GRAIN = 0.25  # the largest standard deviation within its blocks
MOST_SAMPLES = 3_000_000  # of a picture that may be a crop with one edge
NOTHING = (
    "no chart was found: neither a ColorChecker, a grid of dots, a flat field, nor 12 straight, "
    "isolated edges; name the area of an edge or chart (--roi X,Y,WxH)"
)


def read_levels(path: Path) -> tuple[Array, tuple[str, ...]]:
    """Return a finished picture, (height, width, 3) uint8, and warnings about it.

    Raises:
        ImageError: the file cannot be read, is not a finished picture in colour, or is too small.
    """
    source = finished_picture(path)
    height, width = source.pixels.shape[:2]
    if min(height, width) < LEAST[""]:
        raise ImageError(
            f"{path}: this picture has {width}x{height} px; a side needs at least {LEAST['']} px"
        )
    return to_8_bit(source.pixels), source.warnings


def area_in(text: str, picture: Array, path: Path) -> Crop:
    """Return an area of a picture.

    Raises:
        RequestError: the text is not ``[NAME=]X,Y,WxH``.
        ImageError: the area is too small, or outside the picture.
    """
    match = MANUAL.fullmatch(text)
    name = (match["name"] or "") if match else ""
    if match is None or name not in LEAST:
        raise RequestError(
            f"--roi: found {text!r}; expected X,Y,WxH in px from the left and the top, such as "
            f"120,80,160x160, or one of {', '.join(filter(None, LEAST))} and = before it"
        )
    crop = Crop(name, *map(int, re.split("[,x]", match["box"])))
    height, width = picture.shape[:2]
    if not crop.within(width, height) or min(crop.width, crop.height) < LEAST[name]:
        raise ImageError(
            f"{path}: --roi {text}: this area is outside the picture or too small; choose one "
            f"inside {width}x{height} px, with sides of at least {LEAST[name]} px"
        )
    return crop


def picture_quality(path: Path, areas: Sequence[str] = (), name: str = "") -> Quality:
    """Return what the charts of a picture show about its camera.

    Args:
        path: a finished picture.
        areas: ``[NAME=]X,Y,WxH`` in px. An area without a name has one edge or chart. "black" and
            "white" are a light trap and the white around it, for veiling glare. "texture" is a dead
            leaves chart, and "grey" an even patch next to it, whose noise is subtracted. Without
            areas, charts are sought in the whole picture.
        name: of the picture in the report; "" is that of its file.

    Raises:
        ImageError: the file cannot be read, or an area is outside it, or has no chart.
        RequestError: an area has another form, or lacks its partner.
    """
    picture, warnings = read_levels(path)
    crops = [area_in(text, picture, path) for text in areas]
    named = {crop.name: light_of(crop.of(picture)) for crop in crops if crop.name}
    parts = {**_glare(path, named), **_texture(named)}
    edges = []
    for crop in (crop for crop in crops if not crop.name):
        edge = edge_of(light_of(crop.of(picture)))
        found = {} if edge else charts_in(crop.of(picture))
        edges += [edge] if edge else []
        if not edge and not found:
            raise ImageError(
                f"{path}: --roi {crop.box}: this area has no edge, ColorChecker, grid of dots or "
                "flat field. Choose one with 40 px to both sides of a straight edge. The edge must "
                "be turned by about 5 degrees against the pixels"
            )
        if twice := found.keys() & parts:
            raise ImageError(f"{path}: --roi: two areas have a {min(twice)}; measure one at a time")
        parts |= found
    if edges:
        parts["edge"] = edge_found(median_edge(edges), MAIN)
    if not areas:
        parts = charts_in(picture)
        whole = picture.size < MOST_SAMPLES and edge_of(light_of(picture), strict=True)
        if edge := median_edge([whole]) if whole else sharpest(edges_in(picture)):
            parts["edge"] = edge_found(edge, MAIN)
    if not parts:
        raise ImageError(f"{path}: {NOTHING}")
    figures = {key: value for own, _ in parts.values() for key, value in own.items()}
    curves = {key: value for _, own in parts.values() for key, value in own.items()}
    return Quality(name or path.name, figures, curves, tuple(parts), warnings)


def charts_in(picture: Array) -> dict[str, Found]:
    """Return what the charts of a picture show: a ColorChecker, a grid of dots, or a flat field."""
    light = light_of(picture)
    if (patches := find_checker(picture)) is not None:
        errors = asdict(checker_errors(patches.mean((1, 2)), np.array(CHECKER, np.float64)))
        figures, curves = grey_figures(checker_greys(patches))
        return {"ColorChecker": ({**errors, **figures}, curves)}
    if (grid := lens.dot_grid(light)) is not None:
        return {"dots": (lens.dot_figures(*grid), {})}
    if is_flat(light):
        return {"flat field": (lens.shading(light), {})}
    return {}


def checker_greys(patches: Doubles) -> GreyPatches:
    """Return the grey patches of a ColorChecker, from (24, side, side, 3) levels."""
    light = light_of(np.array(CHECKER[GREYS])) @ LUMINANCE
    return GreyPatches(light[::-1], patches[GREYS][::-1, None], rounding=ROUNDING)


def is_flat(light: Doubles) -> bool:
    """Return whether a picture shows an even surface, which may fall off smoothly.

    >>> is_flat(np.ones((64, 64, 3))), is_flat(np.eye(64)[..., None] + np.ones(3))
    (True, False)
    """
    blocks = in_blocks(light @ LUMINANCE, max(min(light.shape[:2]) // lens.BLOCKS, 1))
    means, grain = blocks.mean((1, 3)), np.median(blocks.std((1, 3)))
    y, x = (np.linspace(-1, 1, n) for n in means.shape)
    y, x = np.broadcast_arrays(y[:, None], x)
    terms = np.stack([x**i * y**j for i in range(5) for j in range(5 - i)], axis=-1)
    fitted, *_ = np.linalg.lstsq(terms.reshape(means.size, -1), means.ravel(), rcond=None)
    rest = means.ravel() - terms.reshape(means.size, -1) @ fitted
    even = np.sqrt(np.mean(rest**2)) < UNEVEN * means.mean()
    return bool(even and grain < GRAIN * means.mean())


def _glare(path: Path, named: dict[str, Doubles]) -> dict[str, Found]:
    """Return the veiling glare of a light trap and the white around it (ISO 18844:2017)."""
    if not {"black", "white"} & named.keys():
        return {}
    if not {"black", "white"} <= named.keys():
        raise RequestError("--roi: veiling glare needs two areas, black=X,Y,WxH and white=X,Y,WxH")
    black, white = (float((named[each] @ LUMINANCE).mean()) for each in ("black", "white"))
    if black >= white:
        raise ImageError(f"{path}: --roi: the area black= is not darker than white=; exchange them")
    return {"light trap": ({"glare": 100 * black / white}, {})}


def _texture(named: dict[str, Doubles]) -> dict[str, Found]:
    """Return the texture of a dead leaves chart."""
    if "texture" not in named:
        if "grey" in named:
            raise RequestError("--roi: grey= belongs to a texture; add texture=X,Y,WxH")
        return {}
    return {"texture": texture_found(printed_texture_mtf(named["texture"], named.get("grey")))}
