"""How a camera's raw, or a headerless dump, enters a chain: by what it says of itself.

It enters where DN are read, so nothing is added to it. Configuration and options win over the file.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.camera.profile import DEFAULT_CAMERA, Camera, built_in_cameras, load_camera
from clpipe.chain.chain import Chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.images.dump import Dump, read_dump
from clpipe.images.raw import RAW_SUFFIXES, RawFacts, read_facts, read_raw
from clpipe.images.read import RENDER_SUFFIXES, ReadOptions, SourceImage, read_source
from clpipe.images.tags import Tags, to_attributes
from clpipe.inputs.kept import brightness_warnings, input_warnings
from clpipe.stage import Kind

UNKNOWN_COLOURS = "its colour matrix is not known; its colours stay those of the sensor"


@dataclass(frozen=True)
class RawImage(SourceImage):
    """A mosaic in DN, (height, width), and what the file says of itself, or is told of a dump."""

    said: RawFacts | Dump = field(kw_only=True)


@dataclass(frozen=True)
class RawLoader:
    """Entering with raws: how to make the chain for one, given the settings that it brings.

    ``settings`` lays a configuration and options over settings and draws for the image, ``chain``
    makes the chain that is entered at a step. ``start_at`` is the step to enter at, where one was
    asked for; ``dump`` the geometry of dumps, where it is given.
    """

    settings: Callable[[Settings], Settings]
    chain: Callable[[Settings, str], Chain]
    start_at: str | None = None
    dump: Dump | None = None

    def takes(self, path: Path) -> bool:
        """Whether a file is a raw or a dump, by how its name ends."""
        return path.suffix.lower() in RAW_SUFFIXES or self.takes_as_dump(path)

    def takes_as_dump(self, path: Path) -> bool:
        """Whether a file is a dump: .raw, or of an ending that nothing else has."""
        others = (*RENDER_SUFFIXES, *(e for e in RAW_SUFFIXES if e != ".raw"))
        return self.dump is not None and path.suffix.lower() not in others

    def read(self, path: Path, kind: Kind, how: ReadOptions) -> SourceImage:
        """A raw, a dump, or what else there is of a kind.

        Raises:
            ImageError: it cannot be read, or holds no Bayer mosaic.
        """
        if not self.takes(path):
            return read_source(path, kind, how)
        said = self.dump if self.dump and self.takes_as_dump(path) else read_facts(path)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
        pixels = read_dump(data, path, said) if isinstance(said, Dump) else read_raw(path, said)
        return RawImage(pixels, hashlib.sha256(data).hexdigest(), "", (), {}, said=said)

    def first_chain(self, path: Path) -> Chain:
        """The chain for the first raw, from which it is seen early whether the request is right.

        Raises:
            RequestError: it is not.
        """
        try:
            said = self.dump if self.dump and self.takes_as_dump(path) else read_facts(path)
            return self._chain(path, said)[0]
        except ImageError:
            settings = self.settings(Settings())
            return self.chain(settings, self.start_at or entrance(settings))

    def enter(self, path: Path, image: RawImage) -> tuple[Chain, RawImage]:
        """The chain for a raw, and the raw with its warnings and what it carries to the output.

        Raises:
            ImageError: it cannot enter there, or its levels cannot be.
            RequestError: the chain cannot be made.
        """
        chain, found = self._chain(path, image.said)
        if isinstance(image.said, Dump):
            found += input_warnings(image, chain)
            return chain, replace(image, warnings=tuple(found))
        found += brightness_warnings(image, chain)
        white = getattr(chain.steps[0].method, "white_level", 65535.0)
        if np.count_nonzero(image.pixels >= white) > image.pixels.size / 2:
            found.append(f"most of its samples are not below the white level of {white:g} DN")
        attributes = to_attributes(tags_of(image.said, chain), image.said.orientation)
        return chain, replace(image, warnings=tuple(found), attributes=attributes)

    def _chain(self, path: Path, said: RawFacts | Dump) -> tuple[Chain, list[str]]:
        """The chain for a raw, and what was taken for what it does not say, or says wrongly."""
        brought, found = brought_by(said)
        parameters = dict(brought.parameters)
        own = self.settings(Settings()).drawn("")  # an example, where there is no image yet
        if "white_balance" in found and own.parameters.get("white_balance"):
            del parameters["white_balance"]  # the user's own, not what stands in for the file's
        settings = self.settings(replace(brought, parameters=parameters)).drawn("")
        camera = load_camera(settings.camera)
        low, high = camera.iso_range
        iso = min(max(settings.iso, low), high)
        of_file = isinstance(said, RawFacts) and settings.iso == said.iso
        if of_file and iso != settings.iso:
            found["iso"] = (
                f"its ISO of {settings.iso:g} is beyond camera {camera.name}, "
                f"{low:g} to {high:g}; {iso:g} is taken for denoising"
            )
            settings = replace(settings, iso=iso)
        chain = self.chain(settings, self.start_at or entrance(settings))
        if chain.source is not Kind.RAW:
            raise ImageError(
                f"{path}: a raw enters at {entrance(settings)}; "
                f"{self.start_at} reads {chain.source.label}"
            )
        wanted = settings.parameters.get("mosaic", {}).get("pattern", "RGGB")
        if chain.steps[0].context.pattern != wanted:
            raise ImageError(
                f"{path}: its pattern is {wanted}, which the mosaic stage says, but the chain has "
                "none; list mosaic and quantize first (they are not run on a raw)"
            )
        levels = settings.parameters.get("normalize", {})
        if isinstance(said, RawFacts) and not {"black_level", "white_level"} <= levels.keys():
            raise ImageError(
                f"{path}: its levels cannot be: black {said.black_level}, white {said.white_level} "
                "(--set normalize.black_level, normalize.white_level)"
            )
        parts = {step.stage.name for step in chain.steps}
        # What the user says himself is no doubt.
        if settings.iso != brought.iso or "denoise" not in parts:
            found.pop("no_iso", None)
        if settings.camera != brought.camera or "denoise" not in parts:
            found.pop("camera", None)
        for name in ("white_balance", "color_matrix"):
            same = settings.parameters.get(name) == brought.parameters.get(name)
            if not same or name not in parts:
                found.pop(name, None)
        return chain, list(found.values())


def entrance(settings: Settings) -> str:
    """The first step that reads a raw.

    >>> entrance(Settings())
    'normalize'

    Raises:
        RequestError: there is none.
    """
    for name in settings.stages:
        if all_stages()[name].reads is Kind.RAW and name not in settings.skip:
            return name
    raise RequestError("no stage of the chain reads a raw; normalize does")


def brought_by(said: RawFacts | Dump) -> tuple[Settings, dict[str, str]]:
    """The settings that a raw brings with it, and warnings, by what they are about."""
    if isinstance(said, Dump):
        gray_world = {"white_balance": {"method": "gray_world"}}
        return Settings(parameters=gray_world), {
            "white_balance": "it does not say its white balance; gray_world finds it",
            "color_matrix": UNKNOWN_COLOURS,
        }
    found: dict[str, str] = {}
    known = camera_named(said.make, said.model)
    camera = known.name if known else DEFAULT_CAMERA
    if not known:
        same = said.model.casefold().startswith(said.make.casefold())
        name = said.model if same else f"{said.make} {said.model}"
        found["camera"] = (
            f"there is no profile of {name}; denoising takes the noise of {camera} (--camera)"
        )
    iso = said.iso or Settings().iso
    if not said.iso:
        found["no_iso"] = f"it does not say its ISO; {iso:g} is taken for denoising (--iso)"
    parameters: dict[str, dict[str, Any]] = {"mosaic": {"pattern": said.pattern}}
    if 0 <= said.black_level < said.white_level:
        levels = {"black_level": float(said.black_level), "white_level": float(said.white_level)}
        parameters["normalize"] = levels
    gains = said.gains or said.daylight_gains
    if gains:
        red_and_blue = dict(zip(("red_gain", "blue_gain"), gains, strict=True))
        parameters |= {"inverse_white_balance": red_and_blue, "white_balance": {**red_and_blue}}
    else:
        parameters["white_balance"] = {"method": "gray_world"}
    if not said.gains:
        multipliers = ", ".join(f"{x:.4g}" for x in said.as_shot)
        which = "those of daylight are taken" if gains else "gray_world finds others"
        found["white_balance"] = (
            f"its white balance as shot cannot be, with multipliers {multipliers}; {which}"
        )
    if said.camera_to_srgb:
        matrix = [list(row) for row in said.camera_to_srgb]
        parameters["color_matrix"] = {"method": "camera", "matrix": matrix}
    elif known and known.xyz_to_camera:
        parameters["color_matrix"] = {"method": "camera"}
    else:
        found["color_matrix"] = UNKNOWN_COLOURS
    return Settings(camera=camera, iso=iso, parameters=parameters), found


def camera_named(make: str, model: str) -> Camera | None:
    """The built-in profile of a camera by what its EXIF calls it; None if there is none.

    >>> camera_named("SONY", "ILCE-7RM2").name, camera_named("Canon", "EOS-1") is None
    ('sony-a7r2', True)
    """
    cameras = map(load_camera, built_in_cameras())
    names = (make.casefold(), model.casefold())
    return next((c for c in cameras if (c.make.casefold(), c.model.casefold()) == names), None)


def tags_of(facts: RawFacts, chain: Chain) -> Tags:
    """What a picture's EXIF says of a raw; the ISO is the user's, where he gave another."""
    low, high = chain.camera.iso_range
    own = facts.iso is not None and chain.iso == min(max(facts.iso, low), high)
    return Tags(
        facts.make,
        facts.model,
        facts.iso if own and facts.iso else chain.iso,
        facts.exposure,
        facts.aperture,
        facts.focal_length,
        facts.taken,
    )
