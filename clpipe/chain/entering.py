"""Prepare a chain for one image: its camera, its overscan and its depth."""

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
    """An image with the chain prepared for it, and the pixels that enter the chain.

    ``margins`` are the overscan of ``pixels`` and of the depth.
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
    """Return an image with the chain prepared for it.

    Args:
        chain: the chain for images of this kind.
        pixels: the image, (height, width[, channel]).
        margins: the overscan of ``pixels``. It is cropped if the chain cannot use it.
        depth: returns the image's depth, for a chain, a width and height in px, and margins. It is
            called only if the chain needs depth. None skips depth.
        shot: the camera values in the image's file. Settings override them.
        panorama: the panorama, if the image is the atlas of one.

    Raises:
        ImageError: ``depth`` raises it.
        RequestError: the camera's values contradict each other, or a step cannot use the depth.
    """
    if chain.step_names[0] == chain.names[0] and pixels.ndim == 3:
        width, height = margins.frame_size(*pixels.shape[1::-1])
        optics = chain.optics
        of_lens = ("sensor_width",) if optics.has_lens_sensor else ()
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
    """Return the chain with an image's camera values; the same chain if no step needs them."""
    active = [chain.settings.method(s.name) for s in chain.steps if s.passes]
    needed = {n for own in active for n in optics_names(type(own)) if getattr(own, n) is None}
    if chain.camera.dark_current:
        needed.add("exposure_time")
    said = {name: value for name, value in shot if name in needed}
    if not said:
        return chain
    settings = overlay(chain.settings, {RENDER: said})
    return make_chain(settings, chain.source, until=chain.steps[-1].name)
