"""Kept images: intermediate images of a chain, from which another chain can resume.

A mosaic from another program is loaded in the same way, without attributes.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from clpipe.base.errors import ImageError, KindError, RequestError
from clpipe.base.reading import parse_json
from clpipe.chain.chain import Chain, Step
from clpipe.chain.identity import frame_key, name_of_key
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.chain.rendition import CLEAN
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings, settings_from
from clpipe.images.attributes import read_attributes
from clpipe.images.read import SourceImage
from clpipe.inputs.plausibility import input_warnings

# The attribute of an image without sensor noise. It is "clean" for --truth clean, otherwise "none".
NOISE = "sensor_noise"


def attributes_of(step: Step, chain: Chain, key: str, frame: int | None = None) -> dict[str, str]:
    """Return the attributes of a step's kept image, which allow a chain to resume from it.

    Args:
        step: the step.
        chain: its chain.
        key: the image key.
        frame: the number of the frame in a burst; None if there is no burst.
    """
    is_noisy = step.method.next_context(step.context).noise is not None
    settings = chain.settings
    if settings.noise_key:
        settings = replace(settings, noise_key=frame_key(settings.noise_key, frame))
    return {
        "stage": step.name,
        "kind": step.stage.writes.label,
        "image_key": frame_key(key, frame),
        "settings": json.dumps(settings.record()),
        **({} if is_noisy else {NOISE: CLEAN if step.context.clean else "none"}),
    }


def embedded_settings(attributes: Mapping[str, str], folder: Path | None = None) -> Settings | None:
    """Return the settings of the chain that made a kept image, or None without that attribute.

    Args:
        attributes: the image's attributes.
        folder: the folder that file names in them are relative to; None is the working directory.

    Raises:
        RequestError: the settings are damaged, or contain a name or value that is not allowed.
    """
    if "settings" not in attributes:
        return None
    try:
        values = parse_json(attributes["settings"])
    except ValueError as error:
        raise RequestError(str(error)) from None
    if not isinstance(values, dict):
        raise RequestError(f"found {values!r}, but expected an object")
    return settings_from(values, folder)


@dataclass(frozen=True)
class KeptLoader:
    """Makes the chains for kept images, for a request that has ``start_at``.

    Args:
        request: the request.
        folder: the folder that file names in attributes are relative to; None is the working
            directory.
    """

    request: Request
    folder: Path | None = None

    @property
    def start_at(self) -> str:
        """The step at which the chain of an image starts."""
        assert self.request.start_at is not None
        return self.request.start_at

    def first_chain(self, path: Path) -> Chain:
        """Return the chain of the first image, to reject a wrong request before the run starts.

        Raises:
            RequestError: the chain cannot be made.
        """
        try:
            return self._chain(self.request, embedded_settings(read_attributes(path), self.folder))
        except RequestError:
            return self._chain(self.request, None)

    def enter(
        self, path: Path, source: SourceImage, key: str, is_listed: bool
    ) -> tuple[Chain, SourceImage, str] | None:
        """Return the chain for an image, the image with its warnings, and its image key.

        Return None for an image from a folder that was not kept right before ``start_at``.

        Args:
            path: the image file, for messages.
            source: the image.
            key: the image key if its attributes have none.
            is_listed: whether the user named the image, rather than its folder.

        Raises:
            ImageError: the settings in its attributes cannot be used.
            KindError: the step at ``start_at`` does not read this kind of image.
        """
        key = source.attributes.get("image_key", key)
        # Draws the same values as the image's own run.
        request = self.request.for_image(name_of_key(key), self.request.image)
        chain = self._chain_for(request, path, source.attributes)
        warnings = list(source.warnings)
        if not self._is_next(chain, source.attributes):
            if not is_listed:
                return None
            warnings.append(
                f"this image was kept after {source.attributes.get('stage')}; "
                f"entering at {self.start_at} repeats or skips stages"
            )
        if source.attributes.get("kind", chain.source.label) != chain.source.label:
            raise KindError(path, source.attributes)
        warnings += input_warnings(source, chain)
        return chain, replace(source, warnings=tuple(warnings)), key

    def _chain_for(self, request: Request, path: Path, attributes: Mapping[str, str]) -> Chain:
        try:
            chain = self._chain(request, embedded_settings(attributes, self.folder))
        except RequestError as error:
            raise ImageError(
                f"{path}: the settings in its attributes cannot be used: {error}"
            ) from None
        noise = attributes.get(NOISE)
        if noise == CLEAN and not any(step.adds_noise for step in chain.steps):
            return chain.without_noise_or_denoising()
        return _without_input_noise(chain) if noise in ("none", CLEAN) else chain

    @staticmethod
    def _chain(request: Request, embedded: Settings | None) -> Chain:
        """Return the chain of a request. Its configuration, if any, replaces embedded settings."""
        return request.chain(embedded if request.config is None else None)

    def _is_next(self, chain: Chain, attributes: Mapping[str, str]) -> bool:
        """Return whether an image was kept right before ``start_at``, or has no known step."""
        before = chain.names.index(self.start_at) - 1
        return attributes.get("stage") in (None, chain.names[before] if before >= 0 else None)


def _without_input_noise(chain: Chain) -> Chain:
    """Return the chain for an image without sensor noise: only the chain's steps add noise."""
    steps: list[Step] = []
    noise = None
    for step in chain.steps:
        steps.append(replace(step, context=step.context.replace(noise=noise)))
        noise = step.method.next_context(steps[-1].context).noise
    return replace(chain, steps=tuple(steps))


def kind_message(error: KindError, chain: Chain, start_at: str | None) -> str:
    """Return the message for a kept image of the wrong kind, with the steps that can read it."""
    reads = f", but {start_at} reads {chain.source.label}" if start_at else ""
    return f"{error}{reads}; {_entries_of(error.attributes['kind'], chain)}"


def _entries_of(kind: str, chain: Chain) -> str:
    """Return a sentence with the steps at which an image of a kind can enter a chain."""
    stages = {name: all_stages()[base_name(name)] for name in chain.names}
    names = [
        name
        for name, stage in stages.items()
        if kind in [each.label for each in (stage.reads, *stage.also_reads)]
    ]
    if not names:
        return f"no stage of the chain reads {kind}"
    return f"{kind} can enter with --start-at {' or '.join(names)}"
