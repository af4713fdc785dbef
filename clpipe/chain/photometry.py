"""Photometric ground truth of a picture: exposure, white balance, vignetting and response."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.base.cache import BoundedCache
from clpipe.base.types import Floats
from clpipe.chain.chain import Chain, Step
from clpipe.stage import Kind, Method, ReferenceContext, StageRole, Unchanged
from clpipe.stages.exposure.gain import Exposing

RESPONSE_SIZE = 256  # entries of a table of the response, and of its inverse
INVERSION_STEPS = 64  # steps between two entries when the response is inverted
DIGITS = 6  # significant digits of written numbers
METERED = "metered_ev"  # key in the estimates of exposure

Estimates = Mapping[str, Mapping[str, float]]
Tables = dict[str, list[float]]

# Tables by methods, shared by the images of a run.
RESPONSES: BoundedCache[Tables] = BoundedCache(64)


@dataclass(frozen=True)
class Exposure:
    """The exposure of a picture.

    Args:
        ev: the exposure relative to the unchanged render, in EV. It includes the metered EV.
        gain: the level of a render's 1.0, relative to the sensor's full scale.
        time: the exposure time in s; None if it is unknown.
    """

    ev: float
    gain: float
    time: float | None


def exposure_of(chain: Chain, estimates: Estimates) -> Exposure | None:
    """Return the exposure of a picture; None if its chain has no exposure, like that of a raw.

    Args:
        chain: the chain of the picture.
        estimates: the values that steps estimated from the image, by step name.
    """
    step = chain.step_in(StageRole.EXPOSURE)
    if step is None or not isinstance(step.method, Exposing):
        return None
    metered = estimates.get(step.name, {}).get(METERED, 0.0)
    time = step.method.next_context(step.context).exposure_time
    gain = step.method.gain_at(chain.iso) * 2.0**metered
    return Exposure(step.method.ev + metered, gain, time and time * 2.0**metered)


def photometry_of(chain: Chain, estimates: Estimates) -> dict[str, Any] | None:
    """Return how a render's light became a picture's, as JSON values; None without an exposure.

    Apart from noise, a grey L of the render has the value ``response(x)`` in channel c of the
    picture, where x = ``gain`` L v ``applied[c]`` / ``light[c]``. ``applied`` and ``light`` are in
    ``gains``, and v is the falloff at this pixel. x = 1 is the sensor's full scale.

    The response has 256 entries, for x = i / 255. Its inverse has an entry for each code i / 255,
    the smallest x that has this code.

    Args:
        chain: the chain of the picture.
        estimates: the values that steps estimated from the image, by step name.
    """
    exposure = exposure_of(chain, estimates)
    if exposure is None:
        return None
    return {
        "ev": _rounded(exposure.ev),
        "gain": _rounded(exposure.gain),
        "exposure_time": exposure.time and _rounded(exposure.time),
        "f_number": chain.optics.f_number,
        "iso": chain.iso,
        "gains": _gains(chain, estimates),
        "falloff": _falloff(chain),
        "response": response_of(chain),
    }


def _gains(chain: Chain, estimates: Estimates) -> dict[str, list[float]]:
    """Return the gains of red, green and blue that the light needs, and those that were applied."""
    context = chain.context_after
    step = chain.step_in(StageRole.BALANCE)
    found = estimates.get(step.name, {}) if step else {}
    red, blue = context.applied_gains
    applied = found.get("red_gain", red), found.get("blue_gain", blue)
    names = {"light": context.gains, "applied": applied if step else context.gains}
    return {name: [_rounded(red), 1.0, _rounded(blue)] for name, (red, blue) in names.items()}


def _falloff(chain: Chain) -> dict[str, Any] | None:
    """Return the model of the vignetting, as JSON values; None without vignetting."""
    step = chain.step_in(StageRole.FALLOFF)
    if step is None or isinstance(step.method, Unchanged) or not step.passes:
        return None
    method = step.method
    return {"method": method.method, "law": method.summary, "parameters": method.model_dump()}


def response_of(chain: Chain) -> Tables | None:
    """Return the response to greys and its inverse, 256 numbers each.

    Returns None if the chain ends before display values.
    """
    if chain.result is not Kind.DISPLAY:
        return None
    steps = [step for step in chain.steps if step.stage.role is StageRole.RESPONSE]
    methods: tuple[Method, ...] = tuple(step.method for step in steps)
    return RESPONSES.get(methods, lambda: _tables(steps))


def _tables(steps: Sequence[Step]) -> Tables:
    grey = np.arange(INVERSION_STEPS * (RESPONSE_SIZE - 1) + 1, dtype=np.float32) / np.float32(
        INVERSION_STEPS * (RESPONSE_SIZE - 1)
    )
    image: Floats = np.repeat(grey[None, :, None], 3, 2)
    for step in steps:
        image = step.method.reference(image, ReferenceContext(step.context, {}, {}))
    curve = np.maximum.accumulate(np.clip(image[0, :, 1].astype(np.float64), 0, 1))
    codes = np.arange(RESPONSE_SIZE) / (RESPONSE_SIZE - 1)
    first = np.searchsorted(curve, codes)  # the smallest x of each code
    at = np.clip(first, 1, len(curve) - 1)
    rise = curve[at] - curve[at - 1]
    part = np.where(rise > 0, (codes - curve[at - 1]) / np.where(rise > 0, rise, 1), 1.0)
    inverse = (at - 1 + np.clip(part, 0, 1)) / (len(curve) - 1)
    return {
        "table": [_rounded(v) for v in curve[::INVERSION_STEPS]],
        "inverse": [_rounded(v) for v in inverse],
    }


def _rounded(value: float) -> float:
    return float(f"{float(value):.{DIGITS}g}")
