"""Prepare a chain for one image: its camera, its overscan and its layers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array
from clpipe.camera.spectra import DEFAULT_ILLUMINANT, light, missed_by, observer
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
from clpipe.stages.spectral_response import CameraResponse

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
    if lacks_radiance(chain):
        raise RequestError(
            f"{stage_in(StageRole.EXPOSURE).name}.method={Radiometric.method}: this method needs "
            "spectral bands, but the image is read as red, green and blue. For a render in cd/m2, "
            "use photometric. To read a file's bands, add --layer spectral"
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
    stated, is_whole = chain.settings.render.wavelengths, chain.step_names[0] == chain.names[0]
    if wavelengths == stated or (not wavelengths and not is_whole):
        return chain
    if not wavelengths:
        raise RequestError(
            f"render.wavelengths: found {len(stated)} wavelengths, but the image has red, green "
            "and blue; remove render.wavelengths"
        )
    if stated:
        raise RequestError(
            f"render.wavelengths: found {len(stated)} wavelengths, but the image states those of "
            f"its {len(wavelengths)} bands itself; remove render.wavelengths"
        )
    if not is_whole:
        raise RequestError(
            f"--start-at {chain.step_names[0]}: the image has {len(wavelengths)} spectral bands, "
            "with which a chain begins; remove --start-at"
        )
    settings = overlay(chain.settings, {RENDER: {"wavelengths": wavelengths}})
    return make_chain(settings, chain.source, until=chain.steps[-1].name)


@lru_cache(maxsize=64)
@cached_by_structure
def lacks_radiance(chain: Chain) -> bool:
    """Return whether a chain lacks the spectra from which its exposure is computed."""
    is_needed = any(isinstance(step.method, Radiometric) for step in chain.steps)
    return is_needed and not isinstance(chain.steps[0].method, CameraResponse)


@lru_cache(maxsize=64)
def bands_warning(chain: Chain) -> str:
    """Return a warning about the bands of a spectral render; "" if there is nothing to tell."""
    context = chain.steps[0].context
    nm, sight = context.wavelengths, context.sight
    curves = {"the eye": observer()[:, 1] * light(DEFAULT_ILLUMINANT)}
    if sight:
        channels = context.array_ahead.channels
        curves = {c: sight.response(c) * sight.light for c in channels}
    missed = {name: missed_by(nm, curve) for name, curve in curves.items()}
    worst = max(missed, key=lambda name: missed[name])
    texts = []
    if missed[worst] > MISSED:
        texts.append(
            f"its bands from {nm[0]:g} to {nm[-1]:g} nm miss {100 * missed[worst]:.1f} % of what "
            f"{worst} sees of white; render more bands"
        )
    if sight and not sight.has_colours and len(curves) > 1:
        texts.append(
            f"the sensitivities of camera {chain.camera.name} are not those of red, green and "
            "blue, so there is no matrix to sRGB; set one"
        )
    return "; ".join(texts)


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
