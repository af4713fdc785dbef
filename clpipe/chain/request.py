"""Requests: plain values from options, a configuration, a manifest, a sidecar."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.digests import digests
from clpipe.base.errors import RequestError
from clpipe.base.text import one_of, several
from clpipe.base.tracing import altered
from clpipe.base.validation import first_fault
from clpipe.chain.assignments import parse_assignment
from clpipe.chain.carry import AovSpec, parse_carry
from clpipe.chain.chain import Chain
from clpipe.chain.files import load_configs
from clpipe.chain.formats import EVERY_FORMAT, NPY
from clpipe.chain.keys import KEYS, TABLES
from clpipe.chain.making import make_chain
from clpipe.chain.registry import code_files, load_stage_file
from clpipe.chain.rendition import BASELINES, MOSAIC, TRUTHS
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.truth import noisy_mosaic
from clpipe.stage import Kind

DEFAULTS = Settings()

MOST_PATCHES = 9999  # of an image; the names of their files have four digits


Moments = Literal["start", "middle", "end", "all"]
MOMENTS: tuple[Moments, ...] = get_args(Moments)


class Recorded(BaseModel):
    """The part of a request that decides about a picture's bytes, as a sidecar stores it.

    The rest decides which pictures are made, or whether.
    """

    model_config = ConfigDict(strict=True)

    config: dict[str, Any] | None
    options: dict[str, Any]
    image: dict[str, Any]
    start_at: str | None
    until: str | None
    stage_files: list[str]
    image_name: str
    layer: str | None
    transfer: str | None
    formats: list[str]
    keep: list[str]
    patch: Annotated[int, Field(gt=0)] | None
    patches_per_image: Annotated[int, Field(ge=0, le=MOST_PATCHES)] | Literal["grid"]
    augment: bool
    carry: list[str]
    truth_at: Moments = "middle"

    @model_validator(mode="after")
    def _has_patches(self) -> "Recorded":
        if (self.patch is None) != (self.patches_per_image == 0):
            raise ValueError("patch and patches_per_image contradict each other")
        return self


RECORDED = tuple(Recorded.model_fields)

MADE = 8  # settings that a request, and those that it is replaced by, keep


@dataclass(frozen=True)
class Request:
    """A request: plain values for all that is asked for, so that it can be stored and sent.

    Args:
        config: the values of a configuration, nested as in its file; None where none is named.
        options: values over those of the configuration.
        image: values of one image over both, from its row in a manifest.
        start_at: the first step to run; None is the first of the chain.
        until: the last step to run; None is the last of the chain.
        stage_files: Python files that define further stages; settings load them.
        image_name: the image that draws belong to; "" is none in particular.
        layer: of an EXR, which is the picture; None chooses.
        transfer: the transfer curve of renders in whole numbers; None refuses these.
        max_pixels: larger files are refused; None is the reader's own limit.
        formats: of the last image; () follows from the chain, see :meth:`with_outputs`.
        keep: steps whose image is written too, or "all".
        truth_at: of an exposure of several files, whose pose and layers go with the picture.
        frames: how many frames of each image; None is one picture instead of a burst.
        truths: which of :data:`clpipe.chain.rendition.TRUTHS` are written beside each picture.
        carry: layers that go along with each picture, as :func:`clpipe.chain.carry.parse_carry`
            reads them.
        bracket: what is added to the exposure's EV, for each exposure that is made of each image;
            () is one exposure.
        baselines: which of :data:`clpipe.chain.rendition.BASELINES` are made beside each picture.
        patch: the sides of patches in px, which are written in place of pictures; None is pictures.
        patches_per_image: how many of each picture, at random places, or "grid"; 0 without patches.
        augment: whether patches are flipped and turned.
        made: the settings that were made of ``config`` and ``options``; requests that are replaced
            by others share them.
    """

    config: Mapping[str, Any] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    image: Mapping[str, Any] = field(default_factory=dict)
    start_at: str | None = None
    until: str | None = None
    stage_files: tuple[str, ...] = ()
    image_name: str = ""
    layer: str | None = None
    transfer: str | None = None
    max_pixels: int | None = None
    formats: tuple[str, ...] = ()
    keep: tuple[str, ...] = ()
    carry: tuple[str, ...] = ()
    truth_at: Moments = "middle"
    frames: int | None = None
    truths: tuple[str, ...] = ()
    bracket: tuple[float, ...] = ()
    baselines: tuple[str, ...] = ()
    patch: int | None = None
    patches_per_image: int | Literal["grid"] = 0
    augment: bool = False
    made: BoundedCache[Settings] = field(
        default_factory=lambda: BoundedCache(MADE), compare=False, repr=False
    )

    @classmethod
    def from_options(
        cls,
        *,
        config: str | Path | Sequence[str | Path] | None = None,
        camera: str | None = None,
        iso: float | None = None,
        lens: str | None = None,
        focal_length: float | None = None,
        aperture: float | None = None,
        focus_distance: float | None = None,
        seed: int | None = None,
        noise_key: str | None = None,
        assignments: Sequence[str] = (),
        stages: str | None = None,
        skip: Sequence[str] = (),
        stage_files: Sequence[Path] = (),
        dump: str | None = None,
        values: Mapping[str, Any] | None = None,
        truth: Sequence[str] = (),
        **fields_: Any,
    ) -> "Request":
        """The request of command-line options; None and () are options that are not set.

        Args:
            config: the name of a built-in configuration, or of a TOML file; of several, each lies
                over those before it.
            camera, iso, seed, noise_key, skip, dump: settings.
            lens, focal_length, aperture, focus_distance: settings.
            assignments: texts of the form ``stage.parameter=value``.
            stages: names, separated by commas.
            stage_files: as for the class.
            values: further settings, nested.
            truth: truths and baselines that are written beside each picture.
            **fields_: further fields of the class.

        Raises:
            RequestError: a name or value that is not allowed.
        """
        for name in truth:
            if name not in (*TRUTHS, *BASELINES):
                raise RequestError(f"--truth: {one_of('truth', name, (*TRUTHS, *BASELINES))}")
        for file in stage_files:
            load_stage_file(file)
        plain = {"camera": camera, "iso": iso, "seed": seed, "noise_key": noise_key, "dump": dump}
        plain |= {"lens": lens, "focal_length": focal_length, "aperture": aperture}
        plain |= {"focus_distance": focus_distance}
        options: dict[str, Any] = {k: v for k, v in plain.items() if v is not None}
        if stages is not None:
            options["stages"] = [s.strip() for s in stages.split(",") if s.strip()]
        if skip:
            options["skip"] = list(skip)
        for text in assignments:
            stage, parameter, value = parse_assignment(text)
            options.setdefault(stage, {})[parameter] = value
        configuration = load_configs(several(config)) if config else None
        code = (*(configuration.stage_files if configuration else ()), *stage_files)
        request = cls(
            configuration.values if configuration else None,
            {**options, **(values or {})},
            stage_files=tuple(dict.fromkeys(str(file.resolve()) for file in code)),
            truths=tuple(each for each in truth if each not in BASELINES),
            baselines=tuple(each for each in truth if each in BASELINES),
            **fields_,
        )
        if configuration:
            # They are validated already.
            request.made.get(Identity(request.config), lambda: configuration.settings)
        request.settings()
        request.aov_specs()  # refuses what is wrong
        return request

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "Request":
        """The request that :meth:`record` stored. No stage file is loaded, no name looked up.

        Raises:
            RequestError: the record is not of that form.
        """
        try:
            values = dict(Recorded.model_validate(record))
        except ValidationError as error:
            fault = first_fault(error)
            text = f"{fault.key}: {fault.text}".removeprefix(": ")
            raise RequestError(f"the request in it is damaged: {text}") from None
        if not set(values["formats"]) <= set(EVERY_FORMAT):
            raise RequestError(f"found formats {', '.join(values['formats'])}")
        lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
        request = cls(**{**values, **lists})
        request.aov_specs()  # refuses what is wrong
        return request

    def for_image(self, name: str, values: Mapping[str, Any]) -> Self:
        """The request for one image: its name, and values that hold for it alone."""
        return altered(self, {"image_name": name, "image": values})

    def with_outputs(self, chain: Chain) -> "ResolvedRequest":
        """The request with every output named, as a chain has them.

        The format, where none is chosen, is JPEG; where ``until`` ends the chain before it comes to
        display values, EXR, or of patches ``.npy``. The truth of the mosaic is not kept a second
        time beside that of the development.

        Raises:
            RequestError: the chain has not a step of ``keep``, or no mosaic that is asked for.
        """
        is_whole = self.until is None or chain.result is Kind.DISPLAY
        usual = "jpg" if is_whole else "exr" if self.patch is None else NPY
        formats = tuple(dict.fromkeys(self.formats)) or (usual,)
        keep = chain.select(self.keep)
        own = noisy_mosaic(chain).steps[-1].name if MOSAIC in self.truths else ""
        truth_keep = tuple(step for step in keep if step != own)
        known = {each.name: getattr(self, each.name) for each in fields(Request)}
        known |= {"formats": formats, "keep": keep, "truth_keep": truth_keep}
        return ResolvedRequest(**known)

    def aov_specs(self) -> tuple[AovSpec, ...]:
        """The layers that go along with each picture.

        Raises:
            RequestError: one is wrong.
        """
        return parse_carry(self.carry)

    def settings(self, embedded: Settings | None = None) -> Settings:
        """The settings that are asked for, drawn for the image where there is one.

        Args:
            embedded: the settings that an image carries, which hold where nothing else is set.

        Raises:
            RequestError: a name or value that is not allowed.
        """
        for file in self.stage_files:
            load_stage_file(Path(file))
        settings = self._general()
        if embedded is not None:
            for values in (self.config, self.options):
                embedded = overlay(embedded, values) if values else embedded
            settings = embedded
        if self.image:
            settings = overlay(settings, self.image)
        return settings.drawn(self.image_name) if self.image_name else settings

    def chain(self, embedded: Settings | None = None) -> Chain:
        """The chain that is asked for; ``embedded`` as for :meth:`settings`.

        Raises:
            RequestError: it cannot be made.
        """
        return self.chain_from(self.settings(embedded), self.start_at)

    def chain_from(self, settings: Settings, start_at: str | None) -> Chain:
        """The chain of settings, from a step on.

        Raises:
            RequestError: it cannot be made, or the options name a stage that is not in it.
        """
        chain = make_chain(settings, start_at=start_at, until=self.until)
        known = (*chain.names, *self.image.get("skip", ()), *TABLES)
        for step, value in self.options.items():
            is_table = isinstance(value, Mapping) and step not in KEYS  # where it is a draw
            if is_table and step not in known:
                raise RequestError(one_of("stage in this chain", step, chain.names))
        return chain

    def record(self) -> dict[str, Any]:
        """The request as a sidecar stores it, in JSON values.

        Equal records make the same bytes of the same image: :data:`RECORDED`, and the SHA-256 of
        all files that are named, as "files".

        Raises:
            RequestError: as :meth:`settings`.
        """
        return _as_read_back(
            {**{name: getattr(self, name) for name in RECORDED}, "files": self._files()}
        )

    def record_over(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """The same, from the record of a request that differs in the image alone.

        Raises:
            RequestError: as :meth:`settings`.
        """
        own = {"image": self.image, "image_name": self.image_name, "files": self._files()}
        return {**record, **_as_read_back(own)}

    def _files(self) -> dict[str, str]:
        """The SHA-256 of all files that are named."""
        code = code_files([Path(file) for file in self.stage_files])
        return digests([*self.settings().files(), *map(str, code)])

    def _general(self) -> Settings:
        """The options over the configuration: the settings of all images, nothing drawn."""
        config, options = Identity(self.config), Identity(self.options)
        configured = (
            self.made.get(config, lambda: overlay(DEFAULTS, self.config or {}))
            if self.config
            else DEFAULTS
        )
        if not self.options:
            return configured
        return self.made.get((config, options), lambda: overlay(configured, self.options))


@dataclass(frozen=True)
class ResolvedRequest(Request):
    """A request with every output named, see :meth:`Request.with_outputs`.

    Args:
        truth_keep: steps whose image is written beside a truth that is a picture.
    """

    truth_keep: tuple[str, ...] = ()


def _as_read_back(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values as JSON gives them back."""
    read: dict[str, Any] = json.loads(json.dumps(values))
    return read
