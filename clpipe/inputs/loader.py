"""How an image enters a chain: a render, a camera's raw, or a kept image of any stage."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from clpipe.base.errors import KindError
from clpipe.chain.chain import Chain, entry
from clpipe.chain.methods import base_name, stage_named
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import PICTURE_SUFFIXES, RENDER_SUFFIXES, ReadOptions, SourceImage
from clpipe.inputs.find import Job
from clpipe.inputs.kept import KeptLoader, input_warnings, misplaced
from clpipe.inputs.manifest import check_rows
from clpipe.inputs.raw import RawImage, RawLoader
from clpipe.stage import Kind


@dataclass(frozen=True)
class LoadedImage:
    """An image with its warnings, the chain for it, and its image key."""

    chain: Chain
    source: SourceImage
    key: str


@dataclass(frozen=True)
class ImageLoader:
    """What is asked for, and how files are read."""

    asked: Request
    reading: ReadOptions = field(default_factory=ReadOptions)

    def of(self, job: Job) -> "ImageLoader":
        """The same for one job, with what is said of it alone."""
        if not job.values and not self.is_drawn:
            return self
        return replace(self, asked=self.asked.of(job.key, job.values))

    @cached_property
    def settings(self) -> Settings:
        """The settings that hold where an image brings none."""
        return self.asked.settings()

    @cached_property
    def is_drawn(self) -> bool:
        """Whether each image has settings of its own, some of them drawn at random."""
        return bool(self.settings.draws)

    @cached_property
    def chain(self) -> Chain:
        """The chain of an image that brings no settings."""
        return self.asked.chain()

    @cached_property
    def reads(self) -> Kind:
        """The kind of image that is read; raws aside."""
        start_at = self.asked.start_at
        if start_at is None:
            return entry(self.settings)
        return stage_named("--start-at", base_name(start_at)).reads

    @property
    def reentry(self) -> KeptLoader | None:
        """How kept images enter, where that was asked for."""
        asked = self.asked
        return KeptLoader(asked.start_at, asked.chain) if asked.start_at is not None else None

    @property
    def raws(self) -> RawLoader:
        """How raws enter."""
        asked = self.asked
        return RawLoader(asked.settings, asked.chain_of, asked.start_at, self.settings.dump)

    def endings(self) -> tuple[str, ...]:
        """How the names of the files end that are taken from folders."""
        if self.asked.start_at is None and self.reads is Kind.DISPLAY:
            return PICTURE_SUFFIXES
        return (
            *RENDER_SUFFIXES,
            *(PICTURE_SUFFIXES if self.reading.transfer else ()),
            *RAW_SUFFIXES,
        )

    def first_chain(self, jobs: Sequence[Job]) -> Chain:
        """The chain of the first image, from which it is seen early whether the request is right.

        Raises:
            RequestError: it is not.
        """
        own = self.of(jobs[0])
        if all(self.raws.takes(job.path) for job in jobs):
            return own.raws.first_chain(jobs[0].path)
        return own.reentry.first_chain(jobs[0].path) if own.reentry else own.chain

    def check(self, jobs: Sequence[Job]) -> None:
        """See that what is said of single images is allowed.

        Raises:
            RequestError: it is not; the message says where it stands.
        """
        if said := [job for job in jobs if job.values]:
            brings = self.raws.takes if self.reentry is None else lambda path: True
            check_rows(said, self.settings, brings)

    def read(self, job: Job) -> SourceImage:
        """The image of a job.

        Raises:
            ImageError: it cannot be read, or is of another kind.
        """
        return self.raws.read(job.path, self.reads, self.reading)

    def enter(self, job: Job, source: SourceImage) -> LoadedImage | None:
        """How to go on with an image.

        None for one that was found in a folder of kept images and is not the one to go on from.

        Raises:
            ImageError: it cannot enter there.
        """
        if isinstance(source, RawImage):
            chain, source = self.raws.enter(job.path, source)
            return LoadedImage(chain, source, job.key)
        kept, warnings = source.attributes.get("stage"), list(source.warnings)
        if reentry := self.reentry:
            key = source.attributes.get("image_key", job.key)
            asked = self.asked.of(key, self.asked.row)  # so that the same is drawn for it
            reentry = replace(reentry, make=asked.chain)
            chain = reentry.chain_for(job.path, source.attributes)
            if not reentry.is_next(chain, source.attributes):
                if not job.listed:
                    return None
                again = f"entering at {reentry.start_at} repeats stages or leaves some out"
                warnings.append(f"was kept after {kept}; {again}")
            reentry.check_kind(job.path, chain, source.attributes)
            warnings += input_warnings(source, chain)
            return LoadedImage(chain, replace(source, warnings=tuple(warnings)), key)
        if kept:
            warnings.append(f"was kept after {kept}; is it a render? See --start-at")
        return LoadedImage(self.chain, replace(source, warnings=tuple(warnings)), job.key)

    def is_left_out(self, job: Job, error: Exception) -> bool:
        """Whether an image that cannot enter was only found in a folder of kept images."""
        return isinstance(error, KindError) and self.reentry is not None and not job.listed

    def explain(self, job: Job, error: Exception) -> str:
        """An error as it is told: with the file, and with what can be done."""
        if isinstance(error, KindError):
            return misplaced(error, self.chain, self.reentry)
        message = str(error) or "there is not enough memory for it"
        return message if str(job.path) in message else f"{job.path}: {message}"
