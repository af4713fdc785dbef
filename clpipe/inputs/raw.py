"""Loads camera raws and headerless dumps, and makes their chains from their metadata.

The chain of a raw starts at the first step that reads DN, so no noise is added. Configuration and
options override the metadata.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.camera.profile import DEFAULT_CAMERA, Camera, built_in_name, load_camera
from clpipe.chain.chain import Chain
from clpipe.chain.methods import base_name
from clpipe.chain.registry import all_stages, stage_in
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings
from clpipe.images.dump import Dump, read_dump
from clpipe.images.pixels import DEFAULT_MAX_PIXELS
from clpipe.images.raw import RAW_SUFFIXES, RawInfo, read_raw, read_raw_info
from clpipe.images.read import RENDER_SUFFIXES, SourceImage
from clpipe.images.samples import digest_of
from clpipe.images.tags import Tags, to_attributes
from clpipe.inputs.plausibility import brightness_warnings, input_warnings
from clpipe.reference.cfa import PATTERNS
from clpipe.reference.filter_array import parse_array
from clpipe.stage import Kind, StageRole

GRAY_WORLD = {"method": "gray_world"}  # its limits are those of a known camera
UNKNOWN_COLOURS = "its colour matrix is unknown, so colours stay in the sensor's own space"


@dataclass(frozen=True)
class RawImage(SourceImage):
    """A mosaic in DN, (height, width), with its metadata, or with the settings of a dump."""

    facts: RawInfo | Dump = field(kw_only=True)


def may_be_dump(path: Path) -> bool:
    """Return whether a file is a dump according to its extension, if dumps are configured.

    Dumps have the extension .raw, or one that no other image format has.
    """
    others = (*RENDER_SUFFIXES, *(ending for ending in RAW_SUFFIXES if ending != ".raw"))
    return path.suffix.lower() not in others


@dataclass(frozen=True)
class RawLoader:
    """Loads raws, and dumps if their geometry is set, and makes the chain for each."""

    request: Request
    dump: Dump | None = None

    def is_raw(self, path: Path) -> bool:
        """Return whether a file is a raw or a dump, according to its extension."""
        is_dump = self.dump is not None and may_be_dump(path)
        return path.suffix.lower() in RAW_SUFFIXES or is_dump

    def _facts(self, path: Path) -> RawInfo | Dump:
        if self.dump and may_be_dump(path):
            return self.dump
        return read_raw_info(path, self._max_pixels)

    @property
    def _max_pixels(self) -> int:
        return self.request.max_pixels or DEFAULT_MAX_PIXELS

    def read(self, path: Path) -> RawImage:
        """Return the image of a raw or dump.

        Raises:
            ImageError: it cannot be read, or does not contain a mosaic.
        """
        facts, max_pixels = self._facts(path), self._max_pixels
        if isinstance(facts, Dump):
            pixels = read_dump(path, facts, max_pixels)
        else:
            pixels = read_raw(path, facts, max_pixels)
        return RawImage(pixels, digest_of(path), "", (), {}, facts=facts)

    def first_chain(self, path: Path) -> Chain:
        """Return the chain of the first raw, to reject a wrong request before the run starts.

        Raises:
            RequestError: the chain cannot be made.
        """
        try:
            return self._chain(path, self._facts(path))[0]
        except ImageError:
            return self._chain_from(self.request.settings())

    def enter(self, path: Path, image: RawImage) -> tuple[Chain, RawImage]:
        """Return the chain for a raw, and the raw with its warnings and output attributes.

        Raises:
            ImageError: the raw cannot enter this chain, or its levels are impossible.
            RequestError: the chain cannot be made.
        """
        chain, warnings = self._chain(path, image.facts)
        if isinstance(image.facts, Dump):
            warnings += input_warnings(image, chain)
            return chain, replace(image, warnings=tuple(warnings))
        warnings += [*image.facts.unused, *brightness_warnings(image, chain)]
        white = getattr(chain.steps[0].method, "white_level", 65535.0)
        if np.count_nonzero(image.pixels >= white) > image.pixels.size / 2:
            warnings.append(f"most samples are at or above the white level of {white:g} DN")
        attributes = to_attributes(tags_of(image.facts, chain), image.facts.orientation)
        return chain, replace(image, warnings=tuple(warnings), attributes=attributes)

    def _chain_from(self, settings: Settings) -> Chain:
        return self.request.chain_from(settings, self.request.start_at or first_raw_step(settings))

    def _chain(self, path: Path, facts: RawInfo | Dump) -> tuple[Chain, list[str]]:
        """Return the chain for a raw, and warnings about missing or wrong metadata."""
        embedded, warnings = settings_of(facts)
        parameters = dict(embedded.parameters)
        own = self.request.settings().drawn("")  # an example, because settings may be drawn
        balance = stage_name(StageRole.BALANCE)
        if balance in warnings and own.parameters.get(balance):
            del parameters[balance]  # the user's setting replaces the fallback
        settings = self.request.settings(replace(embedded, parameters=parameters)).drawn("")
        if isinstance(facts, RawInfo):  # its DN are linear, even if those of renders are not
            raw_steps = [name for name in settings.parameters if writes_raw(name)]
            remaining = {k: own for k, own in settings.parameters.items() if k not in raw_steps}
            settings = replace(settings, parameters=remaining)
        camera = load_camera(settings.camera)
        low, high = camera.iso_range
        iso = min(max(settings.iso, low), high)
        is_iso_of_file = isinstance(facts, RawInfo) and settings.iso == facts.iso
        if is_iso_of_file and iso != settings.iso:
            warnings["iso"] = (
                f"its ISO of {settings.iso:g} is outside the range of camera {camera.name}, "
                f"{low:g} to {high:g}; denoising uses {iso:g}"
            )
            settings = replace(settings, iso=iso)
        chain = self._chain_from(settings)
        self._check(path, facts, chain)
        return chain, _remaining(warnings, chain, embedded)

    def _check(self, path: Path, facts: RawInfo | Dump, chain: Chain) -> None:
        """Check that a chain can process a raw.

        Raises:
            ImageError: the chain does not start on DN or has another pattern, or the file's levels
                are impossible and none are set.
        """
        settings = chain.settings
        if chain.source is not Kind.RAW:
            raise ImageError(
                f"{path}: a camera raw starts at {first_raw_step(settings)}, but --start-at "
                f"{self.request.start_at} reads {chain.source.label}. Remove --start-at"
            )
        name = stage_name(StageRole.PATTERN)
        own = settings.parameters.get(name, {})
        pattern = own.get("array") or own.get("pattern", "RGGB")
        if parse_array(pattern).rows != chain.steps[0].context.filter_array.rows:
            raise ImageError(
                f"{path}: its CFA pattern is {pattern}, but the chain has no {name} stage to set "
                f"it. Add {name} and the stages that produce DN; they do not run on a raw"
            )
        name = stage_name(StageRole.LEVELS)
        levels = settings.parameters.get(name, {})
        if isinstance(facts, RawInfo) and not {"black_level", "white_level"} <= levels.keys():
            raise ImageError(
                f"{path}: its levels are impossible: black {facts.black_level}, white "
                f"{facts.white_level}; set {name}.black_level and {name}.white_level"
            )


def _remaining(warnings: dict[str, str], chain: Chain, embedded: Settings) -> list[str]:
    """Return the warnings that still apply, without those about settings that are set or unused.

    Args:
        warnings: the warnings, by topic.
        chain: the chain for the raw.
        embedded: the settings from the raw's metadata.
    """
    settings, stages = chain.settings, {step.stage.name for step in chain.steps}
    is_denoised = chain.step_in(StageRole.DENOISING) is not None
    is_current = {
        "no_iso": is_denoised and settings.iso == embedded.iso,
        "camera": is_denoised and settings.camera == embedded.camera,
    }
    for name in map(stage_name, (StageRole.BALANCE, StageRole.COLOURS)):
        is_same = settings.parameters.get(name) == embedded.parameters.get(name)
        is_current[name] = is_same and name in stages
    return [text for about, text in warnings.items() if is_current.get(about, True)]


def writes_raw(step: str) -> bool:
    """Return whether a step produces DN, so that the chain of a raw starts after it."""
    return all_stages()[base_name(step)].writes is Kind.RAW


def first_raw_step(settings: Settings) -> str:
    """Return the name of the first step that reads a raw.

    >>> first_raw_step(Settings())
    'normalize'

    Raises:
        RequestError: no step does.
    """
    for name in settings.stages:
        if all_stages()[name].reads is Kind.RAW and name not in settings.skip:
            return name
    raise RequestError(
        f"no stage of the chain reads a raw; add the stage {stage_name(StageRole.LEVELS)}"
    )


def stage_name(role: StageRole) -> str:
    """Return the name of the stage that has a role."""
    return stage_in(role).name


def settings_of(facts: RawInfo | Dump) -> tuple[Settings, dict[str, str]]:
    """Return the settings from a raw's metadata, and warnings by topic."""
    balance, colours = stage_name(StageRole.BALANCE), stage_name(StageRole.COLOURS)
    light_parameters: dict[str, dict[str, Any]] = {
        stage_name(StageRole.COLOURS_OF_LIGHT): {"method": "none"}
    }
    if isinstance(facts, Dump):
        gray_world = {balance: {**GRAY_WORLD, "limit": False}}
        return Settings(parameters=gray_world | light_parameters), {
            balance: "the file does not state its white balance; gray_world estimates it",
            colours: UNKNOWN_COLOURS,
        }
    warnings: dict[str, str] = {}
    profile = camera_named(facts.make, facts.model)
    camera = profile.name if profile else DEFAULT_CAMERA
    if not profile:
        is_same = facts.model.casefold().startswith(facts.make.casefold())
        name = facts.model if is_same else f"{facts.make} {facts.model}"
        warnings["camera"] = (
            f"there is no profile of {name}; denoising uses the noise of {camera} (--camera)"
        )
    iso = facts.iso or Settings().iso
    if not facts.iso:
        warnings["no_iso"] = f"the file does not state its ISO; denoising uses {iso:g} (--iso)"
    is_bayer = facts.pattern in PATTERNS
    pattern_settings = (
        {"pattern": facts.pattern} if is_bayer else {"method": "array", "array": facts.pattern}
    )
    parameters = light_parameters | {stage_name(StageRole.PATTERN): pattern_settings}
    if 0 <= facts.black_level < facts.white_level:
        levels = {"black_level": float(facts.black_level), "white_level": float(facts.white_level)}
        parameters[stage_name(StageRole.LEVELS)] = levels
    if not is_bayer and parse_array(facts.pattern).is_gray:
        none = {"method": "none"}
        parameters |= {balance: none, colours: none}
        return Settings(camera=camera, iso=iso, parameters=parameters), warnings
    if facts.gains:
        red_and_blue = dict(zip(("red_gain", "blue_gain"), facts.gains, strict=True))
        light = stage_name(StageRole.BALANCE_OF_LIGHT)
        parameters |= {light: red_and_blue, balance: {**red_and_blue}}
    else:
        parameters[balance] = {**GRAY_WORLD, "limit": profile is not None}
        multipliers = ", ".join(f"{x:.4g}" for x in facts.as_shot)
        warnings[balance] = (
            f"its as-shot white balance is impossible, with multipliers {multipliers}; "
            "gray_world estimates it"
        )
    if facts.camera_to_srgb:
        matrix = [list(row) for row in facts.camera_to_srgb]
        parameters[colours] = {"method": "camera", "matrix": matrix}
    elif profile and profile.xyz_to_camera:
        parameters[colours] = {"method": "camera"}
    else:
        warnings[colours] = UNKNOWN_COLOURS
    return Settings(camera=camera, iso=iso, parameters=parameters), warnings


def camera_named(make: str, model: str) -> Camera | None:
    """Return the built-in profile of a camera, by its make and model in EXIF, or None.

    >>> camera_named("SONY", "ILCE-7RM2").name, camera_named("Canon", "EOS-1") is None
    ('sony-a7r2', True)
    """
    name = built_in_name(f"{make} {model}")
    return load_camera(name) if name else None


def tags_of(facts: RawInfo, chain: Chain) -> Tags:
    """Return the EXIF of the picture of a raw. Its ISO is the file's, unless the user set one."""
    low, high = chain.camera.iso_range
    is_iso_of_file = facts.iso is not None and chain.iso == min(max(facts.iso, low), high)
    return Tags(
        facts.make,
        facts.model,
        facts.iso if is_iso_of_file and facts.iso else chain.iso,
        facts.exposure,
        facts.aperture,
        focal_length=facts.focal_length,
        taken=facts.taken,
    )
