"""Tables and figures of the experiment: values by ISO, depth maps and point clouds."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from clpipe.base.types import Array, Doubles, Floats
from tools.reconstruction.pictures import CAMERA, CLEAN, HALF, IID, KINDS
from tools.reconstruction.views import View
from tools.shared.tables import markdown

COLOURS = dict(
    zip(
        KINDS,
        ("black", "grey", "tab:red", "tab:blue", "tab:cyan", "tab:green", "tab:orange"),
        strict=True,
    )
)
EMPTY = 255, 60  # grey levels of pixels without depth, and of the background of points
POINT = 2  # px, side of a point
TURN, TILT, ZOOM = 25.0, -15.0, 0.85  # view of points: degrees, and factor of the focal length


class Mean(NamedTuple):
    """The mean and the standard deviation of a value over the seeds; NaN for one seed."""

    value: float
    deviation: float

    def text(self, form: str) -> str:
        """Format the value for a cell."""
        if not np.isfinite(self.deviation):
            return format(self.value, form)
        return f"{self.value:{form}} ± {self.deviation:{form}}"


class Table:
    """Means of values by kind and ISO. Kinds that do not depend on the ISO have one value."""

    def __init__(self, values: Iterable[tuple[str, int, float]]) -> None:
        grouped: dict[tuple[str, int], list[float]] = defaultdict(list)
        for kind, iso, value in values:
            grouped[kind, iso].append(value)
        self.isos = sorted({iso for _, iso in grouped})
        self.kinds = [kind for kind in KINDS if any(kind == name for name, _ in grouped)]
        self._means = {
            place: Mean(float(np.mean(each)), float(np.std(each, ddof=1)) if each[1:] else np.nan)
            for place, each in grouped.items()
        }

    def mean(self, kind: str, iso: int) -> Mean:
        """Return the value of a kind at an ISO."""
        return self._means[kind, iso if KINDS[kind].each_iso else self.isos[0]]

    def rows(self, form: str) -> list[list[str]]:
        """Return a row of cells for each kind, starting with its name."""
        return [
            [kind, *(self.mean(kind, iso).text(form) for iso in self.isos)] for kind in self.kinds
        ]


def table_of(rows: Sequence[Any], value: Callable[[Any], float], **where: object) -> Table:
    """Return a table of the rows whose attributes have the values of ``where``."""
    chosen = [r for r in rows if all(getattr(r, name) == what for name, what in where.items())]
    return Table((row.kind, row.iso, value(row)) for row in chosen)


def as_markdown(title: str, tables: Mapping[str, Table], form: str) -> str:
    """Format tables of the same ISOs as one table in Markdown."""
    isos = next(iter(tables.values())).isos
    rows = [[name, *row] for name, table in tables.items() for row in table.rows(form)]
    heads = ["texture", "picture", *(f"ISO {iso}" for iso in isos)]
    return f"### {title}\n\n{markdown(heads, rows)}\n"


def costs_of(tables: Mapping[str, Table]) -> str:
    """Format the cost of noise, and the share of the gap that variance after averaging explains.

    The cost is the loss relative to clean pictures. The gap is the difference between the camera's
    noise and independent noise of the same variance. Its explained share is the part that also
    appears with independent noise of the camera's variance after averaging 2x2.
    """
    rows = []
    for name, table in tables.items():
        for iso in table.isos:
            clean, camera, iid, half = (
                table.mean(kind, iso).value for kind in (CLEAN, CAMERA, IID, HALF)
            )
            costs = [f"{100 * (1 - each / clean):.1f} %" for each in (camera, iid, half)]
            gap = iid - camera
            noise = np.hypot(*(np.nan_to_num(table.mean(k, iso).deviation) for k in (CAMERA, IID)))
            explained = f"{100 * (iid - half) / gap:.0f} %" if gap > max(3 * noise, 0) else ""
            rows.append([name, str(iso), *costs, explained])
    heads = ["", "ISO", "camera costs", "IID costs", f"{HALF}, costs", "explains of the gap"]
    return f"### What noise costs\n\n{markdown(heads, rows)}\n"


def draw(path: Path, panels: Sequence[tuple[str, str, Table]], columns: int, factor: float) -> None:
    """Draw values by ISO, with a line for each kind and error bars over the seeds.

    Args:
        path: the SVG.
        panels: the title, the axis label and the table of each panel, row by row.
        columns: the number of panels in a row.
        factor: a factor for all values.
    """
    from matplotlib.figure import Figure

    from tools.shared.plots import save

    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.7 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis, (title, label, table) in zip(axes.flat, panels, strict=False):
        for kind in table.kinds:
            means = [table.mean(kind, iso) for iso in table.isos]
            axis.errorbar(
                table.isos,
                [factor * each.value for each in means],
                [factor * np.nan_to_num(each.deviation) for each in means],
                color=COLOURS[kind],
                linestyle="--" if KINDS[kind].ending.startswith(".truth") and kind != HALF else "-",
                marker="." if KINDS[kind].each_seed else "",
                capsize=2,
                linewidth=1.2,
                label=kind,
            )
        axis.set_title(title, fontsize=10)
        axis.set(xscale="log", xlabel="ISO", ylabel=label)
        axis.set_ylim(bottom=0)
        axis.set_xticks(table.isos, [str(iso) for iso in table.isos], fontsize=7)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    save(figure, path)


def depth_picture(depth: Floats, nearest: float, farthest: float) -> Array:
    """Draw depth, (height, width) in m, as colours, (height, width, 3) uint8, bright if near."""
    from matplotlib import colormaps

    share = (1 / depth - 1 / farthest) / (1 / nearest - 1 / farthest)
    colours = colormaps["viridis"](np.clip(np.nan_to_num(share), 0, 1), bytes=True)[..., :3]
    return np.where(np.isfinite(depth)[..., None], colours, EMPTY[0]).astype(np.uint8)


def points_of(view: View, depth: Floats, picture: Array) -> tuple[Doubles, Array]:
    """Convert depth to points, (n, 3) in m, with colours, (n, 3) uint8.

    Args:
        view: the view, in the resolution of the depth or a multiple of it.
        depth: (height, width), m; NaN where there is none.
        picture: (height, width, 3), of the same size.
    """
    height, width = depth.shape
    scale = view.depth.shape[1] / width
    y, x = (np.mgrid[:height, :width] + 0.5) * scale
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ np.linalg.inv(view.k).T
    seen = np.isfinite(depth)
    return (rays[seen] * depth[seen, None] - view.t) @ view.r, picture[seen]


def cloud_picture(points: Doubles, colours: Array, view: View) -> Array:
    """Draw points from the side and from above, (height / 2, width / 2, 3) uint8.

    Args:
        points: (n, 3), m.
        colours: (n, 3) uint8.
        view: a camera, which is rotated about the middle of its scene.
    """
    height, width = (side // 2 for side in view.depth.shape)
    turn, tilt = np.radians(TURN), np.radians(TILT)
    about_y = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    about_x = [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    middle = np.array([0, 0, np.median(view.depth)])
    rotated = points @ view.r.T + view.t - middle
    rotated = rotated @ np.transpose(np.array(about_x) @ about_y) + middle
    near = rotated[:, 2] > middle[2] / 4
    rotated, colours = rotated[near], colours[near]
    scale = ZOOM * view.k[0, 0] / 2
    x, y = (scale * rotated[:, :2] / rotated[:, 2:] + np.array([width, height]) / 2).T
    image = np.full((height, width, 3), EMPTY[1], np.uint8)
    order = np.argsort(-rotated[:, 2], kind="stable")  # draws the nearest last
    cell = np.arange(POINT)
    x, y = (np.floor(each[order]).astype(np.intp)[:, None, None] for each in (x, y))
    x, y = np.broadcast_arrays(x + cell, y + cell[:, None])
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    shown = np.broadcast_to(colours[order][:, None, None], (*x.shape, 3))
    image[y[inside], x[inside]] = shown[inside]
    return image
