"""What chain is asked for, as plain values: they can be written down, sent on and asked again."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.text import one_of
from clpipe.chain.chain import Chain, make_chain
from clpipe.chain.files import own_values, parse_assignment
from clpipe.chain.keys import KEYS, OUTPUT
from clpipe.chain.registry import load_stage_file
from clpipe.chain.settings import Settings, overlay

DEFAULTS = Settings()


@dataclass(frozen=True)
class Request:
    """A configuration's own values, options over them, and what an image says over both.

    ``config`` is None where none is named. All are nested values as a configuration file holds
    them. What is drawn at random is drawn for ``image_key``, where there is one.
    """

    config: Mapping[str, Any] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    row: Mapping[str, Any] = field(default_factory=dict)
    start_at: str | None = None
    until: str | None = None
    stage_files: tuple[str, ...] = ()
    image_key: str = ""

    def of(self, image_key: str, row: Mapping[str, Any]) -> "Request":
        """The same for one image, with what is said of it alone."""
        return replace(self, image_key=image_key, row=row)

    def settings(self, under: Settings = DEFAULTS, carried: Settings | None = None) -> Settings:
        """The settings that are asked for.

        ``under`` are settings that hold where nothing is said. ``carried`` are those of a kept
        image; they hold where no configuration is named.

        Raises:
            RequestError: a name or value that is not allowed.
        """
        for file in self.stage_files:
            load_stage_file(Path(file))
        if self.config is not None:
            settings = overlay(under, self.config) if self.config else under
        else:
            settings = carried or under
        for values in (self.options, self.row):
            settings = overlay(settings, values) if values else settings
        return settings.drawn(self.image_key) if self.image_key else settings

    def chain(self, carried: Settings | None = None) -> Chain:
        """The chain that is asked for; ``carried`` as for :meth:`settings`.

        Raises:
            RequestError: it cannot be made.
        """
        return self.chain_of(self.settings(carried=carried), self.start_at)

    def chain_of(self, settings: Settings, start_at: str | None) -> Chain:
        """The chain of such settings, entered at a step.

        Raises:
            RequestError: it cannot be made, or the options name a stage that is not in it.
        """
        chain = make_chain(settings, start_at=start_at, until=self.until)
        for step, value in self.options.items():
            named = isinstance(value, Mapping) and step not in KEYS  # or it is a draw
            if named and step not in (*chain.names, OUTPUT):
                raise RequestError(one_of("stage in this chain", step, chain.names))
        return chain

    def record(self) -> dict[str, Any]:
        """The same as JSON values, from which :func:`request_from_record` makes it."""
        return {**asdict(self), "stage_files": list(self.stage_files)}


def request_from_record(record: Mapping[str, Any]) -> Request:
    """What :meth:`Request.record` wrote down.

    Raises:
        RequestError: it is not of that form.
    """
    try:
        own = {name: record[name] for name in Request.__dataclass_fields__}
        asked = Request(**{**own, "stage_files": tuple(record["stage_files"])})
        asked.settings()
    except (TypeError, KeyError, AttributeError) as error:
        raise RequestError(f"what was asked for is damaged: {error}") from None
    return asked


def request_from_options(
    config: str | None = None,
    camera: str | None = None,
    iso: float | None = None,
    seed: int | None = None,
    assignments: Sequence[str] = (),
    stages: str | None = None,
    skip: Sequence[str] = (),
    start_at: str | None = None,
    until: str | None = None,
    stage_files: Sequence[Path] = (),
    raw_size: str | None = None,
    raw_type: str | None = None,
) -> Request:
    """What the options of the command line ask for; None is not said.

    Raises:
        RequestError: a name or value that is not allowed.
    """
    for file in stage_files:
        load_stage_file(file)
    plain = {"camera": camera, "iso": iso, "seed": seed, "raw_size": raw_size, "raw_type": raw_type}
    values: dict[str, Any] = {k: v for k, v in plain.items() if v is not None}
    if stages is not None:
        values["stages"] = [s.strip() for s in stages.split(",") if s.strip()]
    if skip:
        values["skip"] = list(skip)
    for text in assignments:
        stage, parameter, value = parse_assignment(text)
        values.setdefault(stage, {})[parameter] = value
    own = own_values(config) if config is not None else None
    asked = Request(own, values, {}, start_at, until, tuple(str(f.resolve()) for f in stage_files))
    asked.settings()
    return asked
