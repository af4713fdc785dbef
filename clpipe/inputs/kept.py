"""Going on from a kept image, or from a mosaic of somebody else's."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from clpipe.base.errors import ImageError, KindError, RequestError
from clpipe.chain.chain import Chain, Step
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings, settings_from
from clpipe.images.attributes import read_attributes
from clpipe.images.read import SourceImage
from clpipe.stage import Kind

NOISE = "sensor_noise"  # the attribute of an image that says "none", where others have some


def attributes_of(step: Step, chain: Chain, image_key: str) -> dict[str, str]:
    """What a kept image says of itself, so that a chain can go on with it."""
    noisy = step.method.after(step.context).noise is not None
    return {
        "stage": step.name,
        "kind": step.stage.writes.label,
        "image_key": image_key,
        "settings": json.dumps(chain.settings.record()),
        **({} if noisy else {NOISE: "none"}),
    }


def without_noise(chain: Chain) -> Chain:
    """The chain for an image without sensor noise: it has what the chain's own steps add."""
    steps: list[Step] = []
    noise = None
    for step in chain.steps:
        steps.append(replace(step, context=replace(step.context, noise=noise)))
        noise = step.method.after(steps[-1].context).noise
    return replace(chain, steps=tuple(steps))


def carried_settings(attributes: Mapping[str, str]) -> Settings | None:
    """The settings that a kept image was made with; None where it says nothing of them.

    Raises:
        RequestError: they are damaged, or name what there is not.
    """
    if "settings" not in attributes:
        return None
    try:
        values = json.loads(attributes["settings"])
    except ValueError as error:
        raise RequestError(str(error)) from None
    if not isinstance(values, dict):
        raise RequestError(f"found {values!r}")
    if "stage_files" in values:
        raise RequestError(
            "it names stage files; code comes from --stage-file, never from an image"
        )
    return settings_from(values)


@dataclass(frozen=True)
class KeptLoader:
    """Going on with kept images: how to make the chain, given the settings that one carries."""

    start_at: str
    make: Callable[[Settings | None], Chain]

    def first_chain(self, path: Path) -> Chain:
        """The chain for the first image, from which it is seen early whether the request is right.

        Raises:
            RequestError: it is not.
        """
        try:
            return self.make(carried_settings(read_attributes(path)))
        except RequestError:
            return self.make(None)

    def chain_for(self, path: Path, attributes: Mapping[str, str]) -> Chain:
        """The chain for one image, by what it says of itself.

        Raises:
            ImageError: what it says is of no use.
        """
        try:
            chain = self.make(carried_settings(attributes))
        except RequestError as error:
            raise ImageError(f"{path}: what it was made with cannot be used: {error}") from None
        return without_noise(chain) if attributes.get(NOISE) == "none" else chain

    def check_kind(self, path: Path, chain: Chain, attributes: Mapping[str, str]) -> None:
        """See that an image is of the kind that the first step reads.

        Raises:
            KindError: it is not.
        """
        kind = attributes.get("kind", chain.source.label)
        if kind != chain.source.label:
            raise KindError(path, attributes)

    def is_next(self, chain: Chain, attributes: Mapping[str, str]) -> bool:
        """Whether an image was kept right before the step to start at, as far as it says."""
        before = chain.names.index(self.start_at) - 1
        return attributes.get("stage") in (None, chain.names[before] if before >= 0 else None)


def misplaced(error: KindError, chain: Chain, reentry: KeptLoader | None) -> str:
    """What to say of a kept image that has not the channels that are wanted."""
    reads = f", but {reentry.start_at} reads {chain.source.label}" if reentry else ""
    return f"{error}{reads}; {entries_of(error.attributes['kind'], chain)}"


def entries_of(kind: str, chain: Chain) -> str:
    """Where an image of a kind can enter a chain."""
    stages = {name: all_stages()[base_name(name)] for name in chain.names}
    names = [name for name, stage in stages.items() if stage.reads.label == kind]
    if not names:
        return f"no stage of the chain reads {kind}"
    return f"{kind} can enter with --start-at {' or '.join(names)}"


def brightness_warnings(source: SourceImage, chain: Chain) -> list[str]:
    """What looks wrong with the values of an image that enters."""
    first = chain.steps[0].method
    brightest = float(source.pixels.max())
    found: list[str] = []
    black = getattr(first, "black_level", None)
    if chain.source is Kind.RAW and black is not None and brightest <= black:
        found.append(
            f"its largest sample is {brightest:g}, not above the black level of {black:g} DN"
        )
    if chain.source is Kind.MOSAIC and brightest > 16:
        found.append(
            f"its largest sample is {brightest:g}, but 1 is the white level here; "
            "a raw in DN enters with --start-at normalize"
        )
    return found


def input_warnings(source: SourceImage, chain: Chain) -> list[str]:
    """What looks wrong with an image that enters, and what was taken for what it does not say."""
    found = brightness_warnings(source, chain)
    if "settings" in source.attributes:
        return found
    first = chain.steps[0].method
    black = getattr(first, "black_level", None)
    if chain.settings.iso == Settings().iso and any(s.stage.name == "denoise" for s in chain.steps):
        found.append(f"it does not say its ISO; {chain.settings.iso:g} is taken (--iso)")
    if chain.source in (Kind.RAW, Kind.MOSAIC):
        given = {
            f"{step}.{name}" for step, table in chain.settings.parameters.items() for name in table
        }
        if "mosaic.pattern" not in given:
            pattern = chain.steps[0].context.pattern
            found.append(f"it does not say its pattern; {pattern} is taken (--set mosaic.pattern)")
        levels = {"normalize.black_level", "normalize.white_level"}
        if black is not None and not levels <= given:
            white = getattr(first, "white_level", 1)
            found.append(
                f"it does not say its levels; black {black:g} and white {white:g} are taken "
                "(--set normalize.black_level, normalize.white_level)"
            )
    return found
