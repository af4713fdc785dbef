"""Requests: plain values from options, a configuration, a manifest or a sidecar."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, TypeAdapter, ValidationError

from clpipe.base.cache import BoundedCache, Identity
from clpipe.base.digests import digests
from clpipe.base.errors import RequestError
from clpipe.base.text import as_texts, unknown_name
from clpipe.base.tracing import with_changes
from clpipe.base.url_text import local_path
from clpipe.base.validation import first_fault
from clpipe.chain.carry import AovSpec, parse_carry
from clpipe.chain.chain import Chain
from clpipe.chain.files import load_configs
from clpipe.chain.formats import ALL_FORMATS, NPY
from clpipe.chain.keys import KEYS, TABLES
from clpipe.chain.making import make_chain
from clpipe.chain.options import MAX_PATCHES, Moments
from clpipe.chain.paths import resolve_paths
from clpipe.chain.registry import code_files, load_stage_file, stage_in
from clpipe.chain.rendition import BASELINES, MOSAIC
from clpipe.chain.settings import Settings, overlay
from clpipe.chain.truth import noisy_mosaic
from clpipe.stage import Kind, StageRole

DEFAULTS = Settings()

SETTINGS_CACHE_SIZE = 8  # number of settings that a request and its copies cache


@dataclass(frozen=True)
class RecordedRequest:
    """The part of a request that determines a picture's bytes, as a sidecar stores it.

    The rest of a request determines which pictures are made.

    Args:
        config: the values of a configuration, nested as in its file; None if none is named.
        options: values that override the configuration.
        image: values of one image that override both, from its row in a manifest.
        stage_files: Python files that define further stages; :meth:`Request.settings` loads them.
        image_name: the image that draws belong to; "" if it is no particular image.
        formats: the formats of the last image; () follows from the chain, see
            :meth:`Request.with_outputs`.
        patches_per_image: 0 without patches.

    The other fields are options, see :data:`clpipe.chain.options.OPTIONS`.
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
    formats: tuple[str, ...] = ()
    keep: tuple[str, ...] = ()
    patch: Annotated[int, Field(gt=0)] | None = None
    patches_per_image: Annotated[int, Field(ge=0, le=MAX_PATCHES)] | Literal["grid"] = 0
    augment: bool = False
    carry: tuple[str, ...] = ()
    truth_at: Moments = "middle"


RECORDED_FIELDS = tuple(each.name for each in fields(RecordedRequest))


@dataclass(frozen=True)
class Request(RecordedRequest):
    """A request: plain values of all options, which can be stored and sent to other processes.

    Args:
        truths: which of :data:`clpipe.chain.rendition.TRUTHS` are written next to each picture.
        baselines: which of :data:`clpipe.chain.rendition.BASELINES` are made next to each picture.
        settings_cache: a cache of the settings made of ``config`` and ``options``, which copies
        share.

    The other fields are those of :class:`RecordedRequest`, and options.
    """

    max_pixels: int | None = None
    frames: int | None = None
    truths: tuple[str, ...] = ()
    bracket: tuple[float, ...] = ()
    baselines: tuple[str, ...] = ()
    settings_cache: BoundedCache[Settings] = field(
        default_factory=lambda: BoundedCache(SETTINGS_CACHE_SIZE), compare=False, repr=False
    )

    @classmethod
    def from_options(
        cls,
        *,
        config: str | Path | Sequence[str | Path] | None = None,
        values: Mapping[str, Any] | None = None,
        stage_files: Sequence[str | Path] = (),
        truth: Sequence[str] = (),
        **others: Any,
    ) -> "Request":
        """Return the request of options. None is an option that is not set.

        Args:
            config: built-in configurations or TOML files. Each overrides those before it.
            values: settings that override the configuration, nested as in its file.
            stage_files: Python files that define further stages; they are loaded.
            truth: truths and baselines to write next to each picture.
            **others: further fields of the class.

        Raises:
            RequestError: a name or value is not allowed.
        """
        files = [local_path("stage_files", file) for file in stage_files]
        for file in files:
            load_stage_file(file)
        configuration = load_configs(as_texts(config)) if config else None
        code = (*(configuration.stage_files if configuration else ()), *files)
        request = cls(
            config=configuration.values if configuration else None,
            options=resolve_paths(None, values or {}),
            stage_files=tuple(dict.fromkeys(str(file.resolve()) for file in code)),
            truths=tuple(each for each in truth if each not in BASELINES),
            baselines=tuple(each for each in truth if each in BASELINES),
            **{name: value for name, value in others.items() if value is not None},
        )
        if configuration:
            # These settings are already validated.
            request.settings_cache.get(Identity(request.config), lambda: configuration.settings)
        request.settings()
        request.aov_specs()  # raises an error for invalid specifications
        return request

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "Request":
        """Return the request that :meth:`record` stored. It loads no stage files or configurations.

        Raises:
            RequestError: the record does not have this form.
        """
        damaged = "the request in this file is damaged: "
        known = {name: record[name] for name in RECORDED_FIELDS if name in record}
        try:
            found = _record_adapter().validate_json(json.dumps(known), strict=True)
        except ValidationError as error:
            fault = first_fault(error)
            raise RequestError(damaged + f"{fault.key}: {fault.text}".removeprefix(": ")) from None
        if (found.patch is None) != (found.patches_per_image == 0):
            raise RequestError(f"{damaged}only one of patch and patches_per_image is set")
        if not set(found.formats) <= set(ALL_FORMATS):
            raise RequestError(
                f"{damaged}formats: found {', '.join(found.formats)}; expected some of "
                f"{', '.join(ALL_FORMATS)}"
            )
        request = cls(**vars(found))
        request.aov_specs()  # raises an error for invalid specifications
        return request

    def for_image(self, name: str, values: Mapping[str, Any]) -> Self:
        """Return the request for one image: with its name, and values that only it has."""
        return with_changes(self, {"image_name": name, "image": values})

    def with_outputs(self, chain: Chain) -> "ResolvedRequest":
        """Return the request with every output named, for a chain.

        The default format is JPEG. If ``until`` ends the chain before display values, it is EXR, or
        ``.npy`` for patches. The mosaic's ground truth is not kept again for the development's.

        Raises:
            RequestError: the chain lacks a step of ``keep``, or a mosaic that the truths need.
        """
        is_whole = self.until is None or chain.result is Kind.DISPLAY
        default = "jpg" if is_whole else "exr" if self.patch is None else NPY
        formats = tuple(dict.fromkeys(self.formats)) or (default,)
        keep = chain.select(self.keep)
        mosaic_step = noisy_mosaic(chain).steps[-1].name if MOSAIC in self.truths else ""
        truth_keep = tuple(step for step in keep if step != mosaic_step)
        outputs = {"formats": formats, "keep": keep, "truth_keep": truth_keep}
        return ResolvedRequest(**{**vars(self), **outputs})

    def aov_specs(self) -> tuple[AovSpec, ...]:
        """Return the layers that are warped and written with each picture.

        Raises:
            RequestError: a layer is not valid, see :func:`~clpipe.chain.carry.parse_carry`.
        """
        return parse_carry(self.carry)

    def settings(self, embedded: Settings | None = None) -> Settings:
        """Return the settings of the request, with draws replaced by the image's values, if any.

        Args:
            embedded: the settings in the image's file, which all other values override.

        Raises:
            RequestError: a name or value is not allowed.
        """
        for file in self.stage_files:
            load_stage_file(Path(file))
        settings = self._settings_of_all()
        if embedded is not None:
            for values in (self.config, self.options):
                embedded = overlay(embedded, values) if values else embedded
            settings = embedded
        if self.image:
            settings = overlay(settings, self.image)
        return settings.drawn(self.image_name) if self.image_name else settings

    def chain(self, embedded: Settings | None = None) -> Chain:
        """Return the chain of the request; ``embedded`` as for :meth:`settings`.

        Raises:
            RequestError: the chain cannot be built.
        """
        return self.chain_from(self.settings(embedded), self.start_at)

    def chain_from(self, settings: Settings, start_at: str | None) -> Chain:
        """Return the chain of settings, from a step on.

        Raises:
            RequestError: the chain cannot be built, or the options name a stage that it lacks.
        """
        chain = make_chain(settings, start_at=start_at, until=self.until)
        spectral = stage_in(StageRole.SPECTRUM).name  # in chains of spectral images
        known = (*chain.names, *self.image.get("skip", ()), *TABLES, spectral)
        for step, value in self.options.items():
            # The table of a key is a draw.
            is_table = isinstance(value, Mapping) and step not in KEYS
            if is_table and step not in known:
                raise RequestError(unknown_name("stage in this chain", step, chain.names))
        return chain

    def record(self) -> dict[str, Any]:
        """Return the request as a sidecar stores it, in JSON values.

        It contains the :data:`RECORDED_FIELDS` that have no default values, and under "files" the
        SHA-256 of all files that are named. Equal records of the same image produce the same bytes.

        Raises:
            RequestError: as :meth:`settings`.
        """
        recorded = {name: getattr(self, name) for name in RECORDED_FIELDS}
        return without_defaults(_through_json({**recorded, "files": self._files()}))

    def record_over(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Return :meth:`record`, computed from the record of a request for another image.

        Raises:
            RequestError: as :meth:`settings`.
        """
        changed = {"image": self.image, "image_name": self.image_name, "files": self._files()}
        return without_defaults({**record, **_through_json(changed)})

    def _files(self) -> dict[str, str]:
        """Return the SHA-256 of all files that the request names, by name."""
        code = code_files([Path(file) for file in self.stage_files])
        return digests([*self.settings().files(), *map(str, code)])

    def _settings_of_all(self) -> Settings:
        """Return the settings of all images, without draws: options override the configuration."""
        config, options = Identity(self.config), Identity(self.options)
        configured = (
            self.settings_cache.get(config, lambda: overlay(DEFAULTS, self.config or {}))
            if self.config
            else DEFAULTS
        )
        if not self.options:
            return configured
        return self.settings_cache.get((config, options), lambda: overlay(configured, self.options))


def without_defaults(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of a request in the order of its fields, without default values.

    >>> without_defaults({"files": {}, "keep": [], "image_name": "a.exr"})
    {'image_name': 'a.exr', 'files': {}}
    """
    kept = {k: record[k] for k in RECORDED_FIELDS if k in record and record[k] != _DEFAULTS[k]}
    return {**kept, "files": record["files"]}


_DEFAULTS = {
    name: list(value) if isinstance(value, tuple) else value
    for name, value in vars(RecordedRequest()).items()
}


@cache
def _record_adapter() -> TypeAdapter[RecordedRequest]:
    return TypeAdapter(RecordedRequest)


@dataclass(frozen=True)
class ResolvedRequest(Request):
    """A request with every output named, see :meth:`Request.with_outputs`.

    Args:
        truth_keep: steps whose image is also written for a truth that is a picture.
    """

    truth_keep: tuple[str, ...] = ()


def _through_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values as they are after a round trip through JSON."""
    read: dict[str, Any] = json.loads(json.dumps(values))
    return read
