"""Prepare a chain for one image: its camera, its overscan and its depth."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.depth import depth_warnings, needs_depth, with_depth
from clpipe.chain.keys import RENDER
from clpipe.chain.making import make_chain
from clpipe.chain.overscan import overscan_step_count, with_overscan
from clpipe.chain.panorama import with_panorama
from clpipe.chain.settings import overlay
from clpipe.chain.void import black_area_warning
from clpipe.reference.defocus import Depth
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.reference.panorama import Panorama
from clpipe.stage.method import optics_names


@dataclass(frozen=True)
class PreparedImage:
    """An image with the chain prepared for it, and the pixels that enter the chain.

    ``margins`` are the overscan of ``pixels`` and of the depth.
    """

    chain: Chain
    pixels: Array
    margins: Margins = NO_MARGINS
    depth: Depth | None = None
    warnings: tuple[str, ...] = ()


def prepare_image(
    chain: Chain,
    pixels: Array,
    margins: Margins = NO_MARGINS,
    depth: Callable[[Chain, int, int, Margins], Depth] | None = None,
    shot: Mapping[str, float] | None = None,
    panorama: Panorama | None = None,
) -> PreparedImage:
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
        known = optics.for_image(width, height)
        stated = {k: v for k, v in (shot or {}).items() if k not in known or k in of_lens}
        stated |= {name: known[name] for name in of_lens if name not in stated}
        chain = _with_camera_values(chain, tuple(stated.items())) if stated else chain
        chain.intrinsics_of_render(width, height, stated)
    if panorama:
        chain = with_panorama(chain, panorama)
    if margins and not overscan_step_count(chain):
        pixels, margins = np.ascontiguousarray(margins.cropped(pixels)), NO_MARGINS
    elif margins:
        chain = with_overscan(chain, margins)
    height, width = pixels.shape[:2]
    warnings = tuple(filter(None, [black_area_warning(chain, width, height)]))
    if depth is None or pixels.ndim != 3 or not needs_depth(chain):
        return PreparedImage(chain, pixels, margins, warnings=warnings)
    image_depth = depth(chain, width, height, margins)
    warnings += tuple(depth_warnings(chain, image_depth))
    return PreparedImage(with_depth(chain, image_depth), pixels, margins, image_depth, warnings)


@lru_cache(maxsize=64)
def _with_camera_values(chain: Chain, shot: tuple[tuple[str, float], ...]) -> Chain:
    """Return the chain with an image's camera values; the same chain if no step needs them."""
    active = [chain.settings.method(s.name) for s in chain.steps if s.passes]
    needed = {
        n for method in active for n in optics_names(type(method)) if getattr(method, n) is None
    }
    if chain.camera.dark_current:
        needed.add("exposure_time")
    stated = {name: value for name, value in shot if name in needed}
    if not stated:
        return chain
    settings = overlay(chain.settings, {RENDER: stated})
    return make_chain(settings, chain.source, until=chain.steps[-1].name)
