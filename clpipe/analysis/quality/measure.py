"""Measures the image quality of a chain on its charts, and of pictures of real charts."""

from dataclasses import asdict

import numpy as np

from clpipe.analysis import sharpness
from clpipe.analysis.quality import charts, lens
from clpipe.analysis.quality.charts import CHECKER, GREY, patch_image, patches_of, slanted_edge
from clpipe.analysis.quality.colour import checker_errors
from clpipe.analysis.quality.greys import GreyPatches
from clpipe.analysis.quality.report import (
    CONTRASTS,
    FIGURES,
    MAIN,
    Curve,
    Quality,
    edge_figure,
)
from clpipe.analysis.quality.simulation import ChartCamera
from clpipe.analysis.quality.texture import texture_mtf
from clpipe.analysis.quality.visual_noise import acutance
from clpipe.analysis.sharpness import (
    FREQUENCIES,
    Edge,
    edge_of,
    edges_in,
    frequency_at,
    median_edge,
)
from clpipe.base.types import Array, Doubles
from clpipe.chain.settings import Settings
from clpipe.engine.service import Service
from clpipe.reference.transfer import inverse_srgb_curve

ANGLES = (5.0, 20.0, 70.0, 85.0)  # degrees, of the edges' normals against rows
EDGE = 160  # px, of a chart of an edge
FRAMES = {"edge": 12, "greys": 4, "lens": 4}  # with their own noise, that are averaged or pooled
DETECTED = 0.9
BLUE_DIFFERENCE = np.array([-0.1687, -0.3313, 0.5])  # of R, G and B in Cb (BT.601)
RISE = 0.1, 0.9
SHOWN = np.s_[: len(FREQUENCIES) // 2 + 1]  # up to 0.5 cycles/px
SFR, TEXTURE, TONE, SNR, VISIBLE, CDP = (
    "Edge MTF over cycles/px",
    "Texture MTF over cycles/px",
    "Level over EV from middle grey",
    "SNR in dB over EV from middle grey",
    "Visual noise over EV from middle grey",
    "Detection of a 2:1 contrast over EV from middle grey",
)
Found = tuple[dict[str, float], dict[tuple[str, str], Curve]]


def chain_quality(
    name: str, settings: Settings, service: Service, width: int, height: int
) -> Quality:
    """Return the image quality of a chain.

    Args:
        name: of the camera in the report.
        settings: of the chain.
        service: the service that develops the charts.
        width: of the picture, px, in which figures of the lens are measured.
        height: of that picture.

    Raises:
        RequestError: the chain cannot be built, or has no finished picture.
        ImageError: a chart cannot be developed.
    """
    camera = ChartCamera(settings, service)
    greys = developed_greys(camera)
    parts: tuple[Found, ...] = (
        _edges(camera),
        _texture(camera),
        grey_figures(greys),
        _colours(camera),
        ({"chroma_edge": _chroma_edge(camera)}, {}),
        (lens_figures(camera, greys, width, height), {}),
    )
    measured = {key: value for own, _ in parts for key, value in own.items()}
    curves = {key: value for _, own in parts for key, value in own.items()}
    return Quality(name, {key: measured.get(key, np.nan) for key in FIGURES}, curves)


def light_of(levels: Array) -> Doubles:
    """Return the linear light of sRGB levels, 0 to 255."""
    return inverse_srgb_curve(np.asarray(levels, np.float64) / 255)


def developed_greys(camera: ChartCamera) -> GreyPatches:
    """Return pictures of the grey patches."""
    light = charts.grey_steps()
    frames = camera.frames(patch_image(light[:, None].repeat(3, 1)), "greys", FRAMES["greys"])
    black, *patches = patches_of(frames.astype(np.float64))
    return GreyPatches(light[1:], np.array(patches), black.mean((0, 1, 2)))


def _edges(camera: ChartCamera) -> Found:
    """Return the figures and curves of slanted edges."""
    figures: dict[str, float] = {}
    curves: dict[tuple[str, str], Curve] = {}
    for contrast in CONTRASTS:
        edges: list[Edge] = []
        capacities: list[float] = []
        for angle in ANGLES:
            render = slanted_edge(contrast, angle, EDGE)
            frames = camera.frames(render, f"edge {contrast} {angle}", FRAMES["edge"])
            # Single frames have the noise of a picture; their mean has the sharper edge.
            found = edge_of(light_of(frames.mean(0)))
            edges += [found] if found else []
            single = edge_of(light_of(frames[0]))
            capacities += [single.capacity] if single else []
        if not edges:
            continue
        own, shown = edge_found(median_edge(edges), contrast)
        figures, curves = figures | own, curves | shown
        if contrast == MAIN:
            figures["capacity"] = float(np.median(capacities)) if capacities else np.nan
    return figures, curves


def edge_found(edge: Edge, contrast: float) -> Found:
    """Return the figures and curves of an edge with a contrast."""
    values = {
        "mtf50": edge.mtf50,
        "mtf10": edge.mtf10,
        "nyquist": edge.nyquist,
        "overshoot": 100 * edge.overshoot,
        "undershoot": 100 * edge.undershoot,
    }
    figures = {edge_figure(key, contrast): value for key, value in values.items()}
    if contrast == MAIN:
        channels = zip(sharpness.CURVES[1:], edge.mtf[1:], strict=True)
        figures |= {f"mtf50_{name}": frequency_at(0.5, mtf) for name, mtf in channels}
        figures |= {"edge_red": edge.red, "edge_blue": edge.blue, "capacity": edge.capacity}
    return figures, {(SFR, f"{contrast:g}:1"): Curve(FREQUENCIES[SHOWN], edge.mtf[0][SHOWN])}


def _texture(camera: ChartCamera) -> Found:
    """Return the figures and curve of a texture; NaN if the picture has another size."""
    chart = charts.dead_leaves()
    [picture] = camera.frames(chart, "texture")
    if picture.shape != chart.shape:
        return {"texture_mtf50": np.nan, "acutance": np.nan}, {}
    return texture_found(texture_mtf(light_of(picture), chart.astype(np.float64)))


def texture_found(mtf: Doubles) -> Found:
    """Return the figures and curve of a texture's MTF, up to 0.5 cycles/px."""
    at = FREQUENCIES[SHOWN]
    figures = {"texture_mtf50": frequency_at(0.5, mtf), "acutance": acutance(mtf, at)}
    return figures, {(TEXTURE, ""): Curve(at, mtf)}


def grey_figures(greys: GreyPatches) -> Found:
    """Return the figures and curves of grey patches."""
    stops, visible = np.log2(greys.light / GREY), greys.visual_noise()

    def at_grey(values: Doubles) -> float:
        known = np.isfinite(values)
        return float(np.interp(0.0, stops[known], values[known])) if known.any() else np.nan

    figures = {
        "snr": at_grey(greys.snr),
        "visual_noise": at_grey(visible),
        "dynamic_range": greys.dynamic_range,
        "grey_level": at_grey(greys.luma),
        "gamma": at_grey(greys.gamma),
        "clipping": float(np.log2(greys.saturation / GREY)),
        "black": float(greys.luma[0]),
    }
    curves = {
        (TONE, ""): Curve(stops, greys.luma),
        (SNR, ""): Curve(stops, greys.snr),
        (VISIBLE, ""): Curve(stops, visible),
    }
    light, detected = greys.detection()
    if len(light):
        missed = np.flatnonzero((detected < DETECTED) & (light < GREY))
        figures["detection"] = float(np.log2(light[missed[-1] + 1 if len(missed) else 0] / GREY))
        curves[CDP, ""] = Curve(np.log2(light / GREY), detected)
    return figures, curves


def _colours(camera: ChartCamera) -> Found:
    """Return the errors of a ColorChecker under D65 and under light A."""
    true = np.array(CHECKER, np.float64)
    errors = []
    for under_a in (False, True):
        frames = camera.frames(patch_image(charts.checker(under_a)), f"colours {under_a}")
        patches = patches_of(frames).mean((1, 2, 3))
        if np.ptp(patches, axis=1).max() < 1:  # a monochrome sensor
            return {}, {}
        errors.append(asdict(checker_errors(patches, true)))
    by_day, by_lamp = errors
    figures = {key: value for key, value in by_day.items() if key != "grey_level"}
    return {**figures, **{f"{key}_a": by_lamp[key] for key in ("delta_e", "white_balance")}}, {}


def _chroma_edge(camera: ChartCamera) -> float:
    """Return the distance over which chroma rises from 10 to 90 % at an edge of even luma, px."""
    frames = camera.frames(charts.chroma_edge(EDGE), "chroma edge", FRAMES["edge"], jpeg=True)
    rows = frames.mean((0, 1)) @ BLUE_DIFFERENCE
    side = len(rows)  # a chain may resize the picture
    ends = rows[: side // 4].mean(), rows[-side // 4 :].mean()
    if abs(ends[1] - ends[0]) < 1:  # a monochrome sensor
        return np.nan
    rise = (rows - ends[0]) / (ends[1] - ends[0])
    low, high = (np.interp(level, np.maximum.accumulate(rise), np.arange(side)) for level in RISE)
    return float(high - low)


def lens_figures(
    camera: ChartCamera, greys: GreyPatches, width: int, height: int
) -> dict[str, float]:
    """Return the figures of the lens, from charts that fill the picture.

    Args:
        camera: develops the charts.
        greys: grey patches, from which levels are converted to light.
        width: of the picture, px.
        height: of the picture.
    """
    flat = np.full((height, width), GREY)
    renders = {
        "flat": charts.grey(flat),
        "dots": charts.dots(width, height),
        "glare": charts.glare_spot(width, height),
    }
    field, dotted, spot = (
        camera.frames(render, name, FRAMES["lens"], whole=True).mean(0)
        for name, render in renders.items()
    )
    tiled = np.tile(slanted_edge(MAIN, 20.0), (height // 120 + 1, width // 120 + 1, 1))
    [edges] = camera.frames(tiled[:height, :width], "corners", whole=True)
    side = min(240, *(n // 2 for n in edges.shape[:2]))
    ends = np.s_[:side], np.s_[-side:]
    corners = [edges[y, x] for y in ends for x in ends]
    top, left = ((n - side) // 2 for n in edges.shape[:2])
    middle = edges[top : top + side, left : left + side]
    outer, inner = ([e for part in parts for e in edges_in(part)] for parts in (corners, [middle]))
    grid = lens.dot_grid(light_of(dotted))
    figures = {
        **lens.shading(greys.light_at(field)),
        **(lens.dot_figures(*grid) if grid else {}),
        "glare": lens.glare(greys.light_at(spot)),
    }
    if outer and inner:
        corner, centre = median_edge(outer), median_edge(inner)
        figures |= {"corners": 100 * corner.mtf50 / centre.mtf50}
        figures |= {"corner_red": corner.red, "corner_blue": corner.blue}
    return figures
