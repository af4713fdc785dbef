"""Develops charts with a chain."""

from dataclasses import replace

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array, Floats
from clpipe.chain.making import make_chain
from clpipe.chain.methods import base_name, stage_of
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.options import RunOptions
from clpipe.engine.service import Frame, Service
from clpipe.images.jpeg import JpegEncoding, jpeg_round_trip
from clpipe.reference.curve import to_8_bit
from clpipe.stage import Kind, StageRole

SAME = RunOptions(unchanged=True)  # all frames have one render, which is uploaded once

# Stages that need a scene with motion, depth or surroundings.
SCENE = ("projection", "shutter", "defocus")
# Stages that depend on the place in the picture, or on the rest of it.
PLACE = ("distortion", "vignetting", "glare")


class ChartCamera:
    """Develops charts to finished pictures, in display values before they are rounded.

    An exposure that is metered is that of a grey card, for all charts.

    Args:
        settings: the settings of the chain. Draws are those of the name "quality".
        service: the service that develops.

    Raises:
        RequestError: the chain cannot be built, or does not end with display values.
    """

    def __init__(self, settings: Settings, service: Service) -> None:
        self._service, own = service, metered(settings.drawn("quality"))
        skipped = [name for name in own.step_names if base_name(name) in SCENE]
        self._whole = replace(own, skip=(*own.skip, *skipped))
        blur = [name for name in own.step_names if base_name(name) == "optical_blur"]
        even = overlay(
            own, {name: {"corner": 0.0} for name in blur if hasattr(own.method(name), "corner")}
        )
        places = [name for name in own.step_names if base_name(name) in PLACE]
        self._central = make_chain(replace(even, skip=(*self._whole.skip, *places)))
        if self._central.result is not Kind.DISPLAY:
            raise RequestError(
                f"the chain ends with {self._central.steps[-1].name}, before display values, but "
                "quality is measured in finished pictures; end it with gamma"
            )
        self.has_noise = any(step.adds_noise for step in self._central.steps)
        output = own.output
        self._jpeg = JpegEncoding(output.jpeg_quality, output.jpeg_subsampling)

    def frames(
        self, render: Floats, name: str, count: int = 1, whole: bool = False, jpeg: bool = False
    ) -> Array:
        """Return pictures of a chart, each with its own noise, (frame, height, width, 3).

        Values are levels from 0 to 255. A chain without noise has one frame.

        Args:
            render: the chart.
            name: a name that seeds the noise.
            count: the number of frames.
            whole: whether the chart is the whole picture, with the lens's effects by place, and not
                a part of its centre.
            jpeg: whether the pictures are encoded as JPEG in between, as in a run. Their levels are
                whole.
        """
        chain = make_chain(self._whole) if whole else self._central
        keys = [f"quality {name} {number}" for number in range(count if self.has_noise else 1)]
        ordered = [
            Frame(chain, render, key, encode=False, final=True, options=SAME) for key in keys
        ]
        pictures = [each.result().image for each in self._service.develop(ordered)]
        if jpeg:
            return np.stack([jpeg_round_trip(to_8_bit(each), self._jpeg) for each in pictures])
        return np.stack(pictures) * np.float32(255)


def metered(settings: Settings) -> Settings:
    """Return settings in which a grey card has set the exposure, if it is metered."""
    changed = {}
    for name in settings.step_names:
        method = settings.method(name)
        if stage_of(name).role is StageRole.EXPOSURE and method.method == "auto":
            values = {key: getattr(method, key) for key in ("ev", "headroom")}
            changed[name] = {"method": "gain", **values}
    return overlay(settings, changed)
