"""Prepare a chain for one image: its camera, its overscan and its layers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain, cached_by_structure
from clpipe.chain.keys import RENDER
from clpipe.chain.layers import layer_steps, layer_warnings, reads_layers, with_layers
from clpipe.chain.making import make_chain
from clpipe.chain.overscan import overscan_step_count, with_overscan
from clpipe.chain.panorama import with_panorama
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import overlay
from clpipe.chain.void import black_area_warning
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.reference.panorama import Panorama
from clpipe.stage import ImageLayer, StageRole
from clpipe.stage.method import parameters_with
from clpipe.stages.exposure.radiometric import Radiometric

MISSED = 0.01  # share of a channel's white outside of the bands, above which there is a warning


@dataclass(frozen=True)
class PreparedImage:
    """An image with the chain prepared for it, and the pixels that enter the chain.

    ``margins`` are the overscan of ``pixels`` and of the layers. ``layers``
    are those that steps read, by step, and the chain needs them to stay alive.
    """

    chain: Chain
    pixels: Array
    margins: Margins = NO_MARGINS
    layers: Mapping[str, ImageLayer] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def prepare_image(
    chain: Chain,
    pixels: Array,
    margins: Margins = NO_MARGINS,
    layer: Callable[[Chain, str, int, int, Margins], ImageLayer] | None = None,
    shot: Mapping[str, float] | None = None,
    panorama: Panorama | None = None,
) -> PreparedImage:
    """Return an image with the chain prepared for it.

    Args:
        chain: the chain for images of this kind.
        pixels: the image, (height, width[, channel]).
        margins: the overscan of ``pixels``. It is cropped if the chain cannot use it.
        layer: returns a layer of the image, for a chain, the name of the step that reads it, a
            width and height in px, and margins. None skips layers.
        shot: the camera values in the image's file. Settings override them.
        panorama: the panorama, if the image is the atlas of one.

    Raises:
        ImageError: ``layer`` raises it.
        RequestError: the camera's values contradict each other, or a step cannot use its layer or
            the image.
    """
    if not chain.bands and needs_bands(chain):
        raise RequestError(
            f"{stage_in(StageRole.EXPOSURE).name}.method={Radiometric.method}: this method needs "
            "spectral bands, but the image is in red, green and blue. For a render in cd/m2, use "
            "photometric. To read a file's bands, add --layer spectral"
        )
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
    texts = [black_area_warning(chain, width, height)]
    texts += [bands_warning(chain)] if chain.bands else []
    warnings = tuple(filter(None, texts))
    if layer is None or pixels.ndim != 3 or not reads_layers(chain):
        return PreparedImage(chain, pixels, margins, warnings=warnings)
    layers = {step: layer(chain, step, width, height, margins) for step in layer_steps(chain)}
    warnings += tuple(layer_warnings(chain, layers))
    return PreparedImage(with_layers(chain, layers), pixels, margins, layers, warnings)


@lru_cache(maxsize=64)
def with_bands(chain: Chain, wavelengths: tuple[float, ...]) -> Chain:
    """Return the chain for an image with bands of these wavelengths, nm; () is an image in RGB.

    Raises:
        RequestError: the settings state other bands, or the chain starts at a later step.
    """
    stated = chain.settings.render.wavelengths
    if wavelengths == stated:
        return chain
    if not wavelengths or stated:
        found = f"{len(wavelengths)} bands" if wavelengths else "red, green and blue"
        raise RequestError(
            f"render.wavelengths: found {len(stated)} wavelengths, but the image has {found}, and "
            "states their wavelengths itself; remove render.wavelengths"
        )
    if chain.step_names[0] != chain.names[0]:
        raise RequestError(
            f"--start-at {chain.step_names[0]}: the image has {len(wavelengths)} spectral bands, "
            "with which a chain begins; remove --start-at, or add --layer RGB"
        )
    settings = overlay(chain.settings, {RENDER: {"wavelengths": wavelengths}})
    return make_chain(settings, chain.source, until=chain.steps[-1].name)


@cached_by_structure
def needs_bands(chain: Chain) -> bool:
    """Return whether the exposure of a chain is computed from spectra."""
    return any(isinstance(step.method, Radiometric) for step in chain.steps)


def bands_warning(chain: Chain) -> str:
    """Return a warning if the bands of a render miss light that the sensor sees; "" if not."""
    context = chain.steps[0].context
    if context.sight is None:
        return ""
    array, nm = context.array_ahead, context.wavelengths
    missed = {channel: context.sight.missed(nm, channel) for channel in array.channels}
    worst = max(missed, key=lambda channel: missed[channel])
    if missed[worst] < MISSED:
        return ""
    return (
        f"its bands from {nm[0]:g} to {nm[-1]:g} nm miss {100 * missed[worst]:.1f} % of what "
        f"{worst} sees of white; render more bands"
    )


@lru_cache(maxsize=64)
def _with_camera_values(chain: Chain, shot: tuple[tuple[str, float], ...]) -> Chain:
    """Return the chain with an image's camera values; the same chain if no step needs them."""
    active = [chain.settings.method(s.name) for s in chain.steps if s.passes]
    needed = {
        n
        for method in active
        for n in parameters_with(type(method), "optics")
        if getattr(method, n) is None
    }
    if chain.camera.dark_current:
        needed.add("exposure_time")
    stated = {name: value for name, value in shot if name in needed}
    if not stated:
        return chain
    settings = overlay(chain.settings, {RENDER: stated})
    return make_chain(settings, chain.source, until=chain.steps[-1].name)
