"""Kept images: the attributes that they carry, and how one enters the chain again.

A mosaic from elsewhere enters in the same way, without attributes.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from clpipe.base.errors import ImageError, KindError, RequestError
from clpipe.base.reading import parse_json
from clpipe.chain.chain import Chain, Step
from clpipe.chain.identity import name_in, of_frame
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.chain.rendition import CLEAN
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings, settings_from
from clpipe.images.attributes import read_attributes
from clpipe.images.read import SourceImage
from clpipe.inputs.plausibility import input_warnings

# The attribute of an image without sensor noise: "none", or "clean" where it is of --truth clean.
NOISE = "sensor_noise"


def attributes_of(step: Step, chain: Chain, key: str, frame: int | None = None) -> dict[str, str]:
    """The attributes of the kept image of a step, with which a chain can go on from it.

    Args:
        step: the step.
        chain: its chain.
        key: the image key.
        frame: the number of the frame in a burst; None is no burst.
    """
    is_noisy = step.method.next_context(step.context).noise is not None
    settings = chain.settings
    if settings.noise_key:
        settings = replace(settings, noise_key=of_frame(settings.noise_key, frame))
    return {
        "stage": step.name,
        "kind": step.stage.writes.label,
        "image_key": of_frame(key, frame),
        "settings": json.dumps(settings.record()),
        **({} if is_noisy else {NOISE: CLEAN if step.context.clean else "none"}),
    }


def embedded_settings(attributes: Mapping[str, str], folder: Path | None = None) -> Settings | None:
    """The settings that a kept image was made with; None where it has no such attribute.

    Args:
        attributes: of the image.
        folder: where names of files in them start; None is the working directory.

    Raises:
        RequestError: they are damaged, or hold a name or value that is not allowed.
    """
    if "settings" not in attributes:
        return None
    try:
        values = parse_json(attributes["settings"])
    except ValueError as error:
        raise RequestError(str(error)) from None
    if not isinstance(values, dict):
        raise RequestError(f"found {values!r}")
    return settings_from(values, folder)


@dataclass(frozen=True)
class KeptLoader:
    """The entry of kept images into the chain of a request that has ``start_at``.

    Args:
        request: the request.
        folder: where names of files start that an image carries; None is the working directory.
    """

    request: Request
    folder: Path | None = None

    @property
    def start_at(self) -> str:
        """The step that it enters at."""
        assert self.request.start_at is not None
        return self.request.start_at

    def first_chain(self, path: Path) -> Chain:
        """The chain of the first image, read early so that a wrong request is refused early.

        Raises:
            RequestError: it cannot be made.
        """
        try:
            return self._chain(self.request, embedded_settings(read_attributes(path), self.folder))
        except RequestError:
            return self._chain(self.request, None)

    def enter(
        self, path: Path, source: SourceImage, key: str, is_listed: bool
    ) -> tuple[Chain, SourceImage, str] | None:
        """The chain for an image, the image with its warnings, and its image key.

        None where the image was found in a folder, and was kept after another step than the one
        before ``start_at``.

        Args:
            path: of the image, for messages.
            source: the image.
            key: the image key, where the image does not carry one.
            is_listed: whether the image was named, and not found in a folder.

        Raises:
            ImageError: the settings that it carries cannot be used.
            KindError: it is of another kind than the step reads.
        """
        key = source.attributes.get("image_key", key)
        request = self.request.for_image(name_in(key), self.request.image)  # draws the same
        chain = self._chain_for(request, path, source.attributes)
        warnings = list(source.warnings)
        if not self._is_next(chain, source.attributes):
            if not is_listed:
                return None
            warnings.append(
                f"was kept after {source.attributes.get('stage')}; "
                f"entering at {self.start_at} repeats stages or leaves some out"
            )
        if source.attributes.get("kind", chain.source.label) != chain.source.label:
            raise KindError(path, source.attributes)
        warnings += input_warnings(source, chain)
        return chain, replace(source, warnings=tuple(warnings)), key

    def _chain_for(self, request: Request, path: Path, attributes: Mapping[str, str]) -> Chain:
        try:
            chain = self._chain(request, embedded_settings(attributes, self.folder))
        except RequestError as error:
            raise ImageError(f"{path}: what it was made with cannot be used: {error}") from None
        noise = attributes.get(NOISE)
        if noise == CLEAN and not any(step.adds_noise for step in chain.steps):
            return chain.cleaned()
        return _without_input_noise(chain) if noise in ("none", CLEAN) else chain

    @staticmethod
    def _chain(request: Request, embedded: Settings | None) -> Chain:
        """The chain of a request; a configuration that is named replaces what an image carries."""
        return request.chain(embedded if request.config is None else None)

    def _is_next(self, chain: Chain, attributes: Mapping[str, str]) -> bool:
        """Whether an image was kept right before ``start_at``, as far as it says."""
        before = chain.names.index(self.start_at) - 1
        return attributes.get("stage") in (None, chain.names[before] if before >= 0 else None)


def _without_input_noise(chain: Chain) -> Chain:
    """The chain for an image without sensor noise: only its own steps add any."""
    steps: list[Step] = []
    noise = None
    for step in chain.steps:
        steps.append(replace(step, context=step.context.but(noise=noise)))
        noise = step.method.next_context(steps[-1].context).noise
    return replace(chain, steps=tuple(steps))


def kind_message(error: KindError, chain: Chain, start_at: str | None) -> str:
    """The message for a kept image of the wrong kind: what is read, and where it could enter."""
    reads = f", but {start_at} reads {chain.source.label}" if start_at else ""
    return f"{error}{reads}; {_entries_of(error.attributes['kind'], chain)}"


def _entries_of(kind: str, chain: Chain) -> str:
    """The steps at which an image of a kind can enter a chain, in words."""
    stages = {name: all_stages()[base_name(name)] for name in chain.names}
    names = [
        name
        for name, stage in stages.items()
        if kind in [each.label for each in (stage.reads, *stage.also)]
    ]
    if not names:
        return f"no stage of the chain reads {kind}"
    return f"{kind} can enter with --start-at {' or '.join(names)}"
