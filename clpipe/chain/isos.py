"""Compare the ISOs of settings with the ISO ranges of their cameras."""

from collections.abc import Sequence
from functools import partial
from itertools import product

from clpipe.base.errors import RequestError
from clpipe.camera.profile import load_camera
from clpipe.chain.drawing import draw_extremes
from clpipe.chain.draws import Truncated
from clpipe.chain.limits import Limits
from clpipe.chain.settings import Settings


def check_cameras(settings: Settings) -> None:
    """Check that every camera that can be drawn exists, and that a camera has each ISO.

    If cameras have different ranges, the ISO is drawn from the part that the drawn camera has.

    Raises:
        RequestError: a camera cannot be loaded, an ISO is outside the range of every camera, or a
            camera has no ISO that can be drawn.
    """
    cameras = [load_camera(name) for name in settings.names_of("camera")]
    draw = settings.draws.get("iso")
    if draw is None or draw.follows:
        isos: Sequence[float] = [settings.iso]
        if draw:
            limits = partial(settings.limits, isos=settings.isos())
            isos = draw_extremes(settings.draws, settings.constants(), limits)["iso"]
        for camera, iso in product(cameras, isos):
            camera.check_iso(iso, settings.pushed)
        return
    ranges = [settings.drawn_isos(camera) for camera in cameras]
    lows, highs = [limits_.low for limits_ in ranges], [limits_.high for limits_ in ranges]
    for iso in draw.extremes(Limits(min(lows), max(highs)), ()):
        if not any(low <= iso <= high for low, high in zip(lows, highs, strict=True)):
            lowest, highest = lows.index(min(lows)), highs.index(max(highs))
            cameras[lowest if iso < min(lows) else highest].check_iso(iso)
    for camera, limits_ in zip(cameras, ranges, strict=True):
        if draw.truncated(limits_) is None:
            low, high = camera.iso_range
            raise RequestError(
                f"iso: found {draw.record()}, but none of these ISOs is in the range of camera "
                f"{camera.name}, {low:g} to {high:g}; remove this camera, or change the range"
            )


def draw_note(settings: Settings) -> str:
    """Return a note on the ISOs that are drawn; "" if every camera has all of them."""
    draw, parts = settings.draws.get("iso"), []
    if draw and not draw.follows and "camera" not in settings.draws:
        camera = load_camera(settings.camera)
        high = camera.iso_range[1]
        if max(draw.extremes(settings.drawn_isos(camera), ())) <= high:
            return ""
        return (
            f"iso: the draw goes above {high:g}, the highest ISO of {camera.name}; above it, noise "
            "grows with the ISO as in a picture that is pushed"
        )
    for camera in map(load_camera, settings.names_of("camera")) if draw else ():
        truncated = draw and draw.truncated(Limits(*camera.iso_range))
        # Truncating a normal distribution only removes its tails.
        if truncated != draw and not isinstance(truncated, Truncated):
            parts.append("{} from {:g} to {:g}".format(camera.name, *camera.iso_range))
    return f"iso: drawn within each camera's range: {', '.join(parts)}" if parts else ""
