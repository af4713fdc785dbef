"""Develops a scene: converts the camera's picture to linear light, and runs a chain on it."""

import math
from dataclasses import replace

import numpy as np

from clpipe.analysis.matching.columns import Noise, noise_of_frames
from clpipe.analysis.matching.scenes import Scene
from clpipe.analysis.matching.space import RESIZE
from clpipe.base.cache import BoundedCache
from clpipe.base.types import Array, Floats
from clpipe.chain.chain import Chain
from clpipe.chain.making import make_chain
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.engine.device import Device
from clpipe.engine.options import RunOptions
from clpipe.engine.service import Frame, Service
from clpipe.images.jpeg import jpeg_round_trip
from clpipe.stage import Kind, Method, ReferenceContext, StageRole

SAME = RunOptions(unchanged=True)  # all frames have one render, which is uploaded once
LINEAR = 16  # linear-light scenes that are cached for one tone curve
# Stages that have already been applied to a picture.
SEEN = (StageRole.SHUTTER, StageRole.LENS, StageRole.FALLOFF)


class Simulator:
    """Develops scenes with varying settings on one device.

    Args:
        device: the device; None is NumPy.
    """

    def __init__(self, device: Device | None) -> None:
        self.device = device
        self._service = Service([device])
        self._linear = BoundedCache[Floats](LINEAR)

    def noise(self, settings: Settings, scene: Scene, key: str, count: int | None = None) -> Noise:
        """Return the noise of a scene's development, at the intensities of the camera's pictures.

        A burst is developed once for each frame, and compared with its own mean, like that of the
        camera. Other frames are compared with their development without noise.

        Args:
            settings: the settings of the development.
            scene: the scene, whose mean is developed and encoded like its frames.
            key: the key that seeds the noise.
            count: the number of frames; None uses the scene's number.
        """
        seen = [name for name in settings.step_names if all_stages()[base_name(name)].role in SEEN]
        chain = make_chain(replace(settings, skip=(*settings.skip, *seen)))
        keys = [f"{key}:{scene.name}:{number}" for number in range(count or len(scene.frames))]
        linear = self._linear_light(chain, scene)
        ordered = [Frame(chain, linear, name, options=SAME) for name in keys]
        if not scene.own_mean:
            ordered.append(Frame(chain.without_noise(), linear, "", options=SAME))
        pictures = [each.result().encoded for each in self._service.develop(ordered)]
        frames = [finished(picture, scene) for picture in pictures]
        mean = None if scene.own_mean else frames.pop()
        return noise_of_frames(frames, mean, scene.noise.level)

    def _linear_light(self, chain: Chain, scene: Scene) -> Floats:
        """Return the scene in linear light, with the size that the chain starts on."""
        methods, scale, gain = undoing(chain), scale_of(chain), gain_of(chain)
        key = scene, scale, gain, *((type(m), m.model_dump_json()) for m in methods)

        def undone() -> Floats:
            image = (scene.clean / 255).astype(np.float32)
            for method in methods:
                image = method.reference(image, ReferenceContext(chain.steps[0].context, {}, {}))
            return np.ascontiguousarray(enlarged(image / np.float32(gain), scale))

        return self._linear.get(key, undone)


def finished(pixels: Array | None, scene: Scene) -> Floats:
    """Return a developed picture encoded like the scene's frames, (height, width, 3), 0 to 255."""
    assert pixels is not None
    return (jpeg_round_trip(pixels, scene.jpeg) if scene.jpeg else pixels).astype(np.float32)


def gain_of(chain: Chain) -> float:
    """Return the factor by which a chain brightens linear light, without its curves."""
    in_light = (s.method for s in chain.steps if s.stage.reads is Kind.RGB)
    return math.prod(float(method.gain) for method in in_light if hasattr(method, "gain"))


def scale_of(chain: Chain) -> float:
    """Return the size of a chain's picture relative to its input."""
    scales = (getattr(s.method, "scale", 1.0) for s in chain.steps if s.stage.name == RESIZE)
    return math.prod(scales)


def enlarged(image: Floats, scale: float) -> Floats:
    """Return a picture, (height, width, 3), enlarged linearly by the inverse of a scale."""
    if scale == 1:
        return image
    from scipy import ndimage

    height, width = image.shape[:2]
    factors = round(height / scale) / height, round(width / scale) / width, 1
    return np.asarray(ndimage.zoom(image, factors, order=1, mode="nearest", grid_mode=True))


def undoing(chain: Chain) -> list[Method]:
    """Return the methods that convert a finished picture to the light that the chain starts on."""
    found = []
    for step in reversed(chain.steps):
        inverse_stage = all_stages().get(f"inverse_{step.stage.name}")
        if step.stage.role is StageRole.RESPONSE and inverse_stage:
            inverse = inverse_stage.by_name[step.method.method]
            values = step.method.model_dump(include=set(inverse.model_fields))
            found.append(inverse.model_validate(values))
    return found
