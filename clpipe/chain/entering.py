"""One way for an image into its chain: its camera, its overscan and its depth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.depth import needs_depth, warnings_of, with_depth
from clpipe.chain.keys import RENDER
from clpipe.chain.making import make_chain
from clpipe.chain.overscan import steps_of_overscan, with_overscan
from clpipe.chain.panorama import with_panorama
from clpipe.chain.settings import overlay
from clpipe.chain.void import check_void
from clpipe.reference.defocus import Depth
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.reference.panorama import Panorama
from clpipe.stage.method import optics_names


@dataclass(frozen=True)
class Entered:
    """An image in its chain: the chain for it, and what of the image goes through that.

    ``margins`` say how far ``pixels``, and depth, go on beyond the picture.
    """

    chain: Chain
    pixels: Array
    margins: Margins = NO_MARGINS
    depth: Depth | None = None
    warnings: tuple[str, ...] = ()


def enter(
    chain: Chain,
    pixels: Array,
    margins: Margins = NO_MARGINS,
    depth: Callable[[Chain, int, int, Margins], Depth] | None = None,
    shot: Mapping[str, float] | None = None,
    panorama: Panorama | None = None,
) -> Entered:
    """An image with the chain for it.

    Args:
        chain: for images of its kind.
        pixels: of the image, (height, width[, channel]).
        margins: how far they go on beyond the picture; cropped where the chain makes no use of it.
        depth: gives the depth for a chain that needs it, of an image of some width and height with
            some margins; None leaves it out.
        shot: what the image says of its camera, which holds where nothing else is stated.
        panorama: what the image is an atlas of, where it is one.

    Raises:
        ImageError: what ``depth`` raises.
        RequestError: what is known of the camera contradicts itself, or the depth is of no use.
    """
    if chain.step_names[0] == chain.names[0] and pixels.ndim == 3:
        width, height = margins.inside(*pixels.shape[1::-1])
        optics = chain.optics
        of_lens = ("sensor_width",) if optics.is_sensor_of_lens else ()
        own = optics.for_image(width, height)
        said = {k: v for k, v in (shot or {}).items() if k not in own or k in of_lens}
        said |= {name: own[name] for name in of_lens if name not in said}
        chain = _with_shot(chain, tuple(said.items())) if said else chain
        chain.intrinsics_of_render(width, height, said)
    if panorama:
        chain = with_panorama(chain, panorama)
    if margins and not steps_of_overscan(chain):
        pixels, margins = np.ascontiguousarray(margins.cropped(pixels)), NO_MARGINS
    elif margins:
        chain = with_overscan(chain, margins)
    height, width = pixels.shape[:2]
    warnings = tuple(filter(None, [check_void(chain, width, height)]))
    if depth is None or pixels.ndim != 3 or not needs_depth(chain):
        return Entered(chain, pixels, margins, warnings=warnings)
    found = depth(chain, width, height, margins)
    warnings += tuple(warnings_of(chain, found))
    return Entered(with_depth(chain, found), pixels, margins, found, warnings)


@lru_cache(maxsize=64)
def _with_shot(chain: Chain, shot: tuple[tuple[str, float], ...]) -> Chain:
    """The chain with what an image says of its camera; the same one where no step needs that."""
    active = [chain.settings.method(s.name) for s in chain.steps if s.passes]
    needed = {n for own in active for n in optics_names(type(own)) if getattr(own, n) is None}
    if chain.camera.dark_current:
        needed.add("exposure_time")
    said = {name: value for name, value in shot if name in needed}
    if not said:
        return chain
    settings = overlay(chain.settings, {RENDER: said})
    return make_chain(settings, chain.source, until=chain.steps[-1].name)
