"""Makes a development's edges as sharp as those of a camera's pictures.

Noise does not depend on the blur of the lens, and hardly on the limit of sharpening. Both are
therefore chosen after the search, for the MTF50 and the overshoot of the camera's edges.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from clpipe.analysis.matching.scenes import Scene
from clpipe.analysis.quality.charts import slanted_edge
from clpipe.analysis.quality.measure import light_of
from clpipe.analysis.sharpness import Edge, edge_of, edges_in, median_edge, sharpest
from clpipe.base.types import Array
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner

CONTRAST, ANGLES, SIDE = 4.0, (5.0, 20.0, 70.0, 85.0), 120  # of the edges that are developed
SIGMAS, LIMITS = (0.1, 3.0), (0.0, 0.2)  # of optical_blur.sigma and sharpen.limit
ROUNDS, STEPS = 3, 8  # of the search, and of each bisection


@dataclass(frozen=True)
class Sharpness:
    """The sharpest edges of a camera's pictures, and those of the development."""

    theirs: Edge
    ours: Edge

    def __str__(self) -> str:
        figures = (
            ("MTF50", f"{self.theirs.mtf50:.2f}", f"{self.ours.mtf50:.2f} cycles/px"),
            ("overshoot", f"{self.theirs.overshoot:.0%}", f"{self.ours.overshoot:.0%}"),
        )
        parts = (f"{name} {theirs} in the pictures, {ours} here" for name, theirs, ours in figures)
        return "edges: " + "; ".join(parts)


def as_sharp(
    settings: Settings, theirs: Edge | None, device: Device | None
) -> tuple[Settings, Sharpness | None]:
    """Return settings with edges as sharp as a camera's, and the figures of both.

    The settings do not change, and there are no figures, without an edge of the camera, or if the
    chain has no blur of a lens. Without the unsharp mask, only the blur is fitted.

    Args:
        settings: of the development.
        theirs: of the camera, see :func:`edge_in`.
        device: the device that develops edges; None is NumPy.
    """
    numbers = {
        name: number
        for name, number in (("optical_blur", "sigma"), ("sharpen", "limit"))
        if name in settings.step_names and hasattr(settings.method(name), number)
    }
    if theirs is None or "optical_blur" not in numbers:
        return settings, None
    renders = [slanted_edge(CONTRAST, angle, SIDE) for angle in ANGLES]

    def over(sigma: float, limit: float) -> Settings:
        values = {"optical_blur": {"sigma": sigma}, "sharpen": {"limit": limit}}
        return overlay(settings, {name: values[name] for name in numbers})

    def ours(sigma: float, limit: float) -> Edge:
        runner = Runner(make_chain(over(sigma, limit)).without_noise(), device)
        developed = (edge_of(light_of(picture(runner, render))) for render in renders)
        return median_edge([edge for edge in developed if edge])

    def too_much(limit: float, sigma: float) -> bool:
        return ours(sigma, limit).overshoot > theirs.overshoot

    def too_blunt(sigma: float, limit: float) -> bool:
        return ours(sigma, limit).mtf50 < theirs.mtf50

    sigma = 0.65
    for _ in range(ROUNDS):
        limit = _solved(too_much, *LIMITS, sigma) if "sharpen" in numbers else 0.0
        sigma = _solved(too_blunt, *SIGMAS, limit)
    found = round(sigma, 3), round(limit, 4)
    return over(*found), Sharpness(theirs, ours(*found))


def edge_in(scenes: Sequence[Scene]) -> Edge | None:
    """Return the sharpest edges of the scenes' means; None if they have fewer than 12."""
    means = [scene.clean.round().astype("uint8") for scene in scenes]
    return sharpest([edge for mean in means for edge in edges_in(mean)])


def picture(runner: Runner, render: Array) -> Array:
    """Return a developed render, uint8."""
    encoded = runner.run(render, "edge").encoded
    assert encoded is not None
    return encoded


def _solved(
    exceeds: Callable[[float, float], bool], low: float, high: float, other: float
) -> float:
    """Return the number above which ``exceeds(number, other)`` holds, or the nearer end."""
    for _ in range(STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if exceeds(middle, other) else (middle, high)
    return (low + high) / 2
