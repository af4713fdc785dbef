"""Black areas of a picture: a lens shows more of the scene than the render contains."""

from functools import lru_cache
from math import ceil

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.chain.chain import Chain
from clpipe.chain.panorama import projection_of
from clpipe.reference.geometry import Composition

SAMPLES = 128, 96  # samples across and down the picture
MIN_BLACK_SHARE = 5e-4  # the smallest share of black pixels that causes a warning
MAX_OVERSCAN = 0.5  # the largest overscan that a warning proposes, relative to the longer side


def black_area_warning(chain: Chain, width: int, height: int) -> str:
    """Return a warning if the lens sees past the render, which leaves black areas; else "".

    Args:
        chain: the chain of the picture.
        width: the width of the input in px, with its overscan.
        height: its height in px, with its overscan.

    Raises:
        ImageError: the distortion folds the image over.
    """
    if chain.geometry is None:
        return ""
    try:
        share, distance = _black_area(chain, width, height)
    except ImageError as error:
        lens = chain.optics.calibration
        if lens and lens.is_of_smaller_sensor:
            raise ImageError(
                f"{lens.name} was calibrated on a smaller sensor than {chain.camera.name}'s, "
                "so its distortion is undefined in the corners; choose another lens, or a camera "
                "with a smaller sensor"
            ) from None
        raise error from None
    if share < MIN_BLACK_SHARE:
        return ""
    if projection_of(chain):
        return (
            f"{100 * share:.1f} % of the lens's field of view is black, because no view "
            "covers it; add the missing faces, or make field_of_view smaller"
        )
    warps = [step.name for step in chain.steps if hasattr(step.method, "fit")]
    fit = f"set {warps[0]}.fit=true" if warps else "make the picture smaller"
    most = MAX_OVERSCAN * max(width, height)
    overscan = (
        f"render {ceil(distance)} px more on each side (overscan), or " if distance < most else ""
    )
    return (
        f"{100 * share:.1f} % of the picture is black, because the lens shows parts of the scene "
        f"outside the render; {overscan}{fit}"
    )


@lru_cache(maxsize=64)
def _black_area(chain: Chain, width: int, height: int) -> tuple[float, float]:
    """Return the share of a picture that lies outside its image, and the largest distance in px."""
    geometry = chain.geometry
    assert geometry
    columns, rows = geometry.size(width, height)
    positions = [
        np.concatenate([[0.5], (np.arange(n) + 0.5) * (side / n), [side - 0.5]])
        for n, side in zip(SAMPLES, (columns, rows), strict=True)
    ]
    x, y = np.meshgrid(*positions)
    with np.errstate(all="ignore"):
        u, v = geometry.origins(x, y, width, height)
        distance = np.maximum(np.maximum(-u, u - width), np.maximum(-v, v - height))
    distance = np.where(np.isfinite(distance), distance, np.inf)
    inside = np.s_[1:-1, 1:-1]
    black = distance[inside] > 0
    if projection := projection_of(chain):
        rest = Composition(geometry.parts[1:])
        x, y = rest.origins(x[inside], y[inside], *projection.size(width, height))
        black = black[np.isfinite(projection.lens.rays(x, y)[0])]
    return float(black.mean()) if black.size else 1.0, float(distance.max())
