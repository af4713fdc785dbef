"""Where the pictures of a run go: names and formats."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.chain.chain import Chain
from clpipe.chain.truth import variance_of
from clpipe.engine.device import Device
from clpipe.engine.runner import Result, Runner
from clpipe.images.dng import write_dng
from clpipe.images.read import SourceImage
from clpipe.images.tags import TAG_ATTRIBUTES, Tags, from_attributes, upright
from clpipe.images.write import JPEG_MAX_SIDE, write_display, write_exr
from clpipe.inputs.find import Job
from clpipe.inputs.kept import attributes_of
from clpipe.outputs.folder import RESUMABLE, trouble_with
from clpipe.outputs.formats import DNG, FORMATS, SIDECAR, ending_of, samples
from clpipe.outputs.negative import negative_of
from clpipe.outputs.renditions import MAPS, Rendition, RenditionPlan
from clpipe.stage import Kind


@dataclass(frozen=True)
class OutputWriter:
    """Where results go, in which formats, how many of each image, and which stages' images too."""

    folder: Path
    formats: tuple[str, ...]
    burst: RenditionPlan = field(default_factory=RenditionPlan)
    keep: tuple[str, ...] = ()

    def burst_of(self, job: Job) -> RenditionPlan:
        """How many frames are made of a job's image."""
        return self.burst if job.frames is None else replace(self.burst, frames=job.frames)

    def pictures_of(self, job: Job) -> tuple[str, ...]:
        """What stands behind the name of each picture that is made of a job's image."""
        names = self.burst_of(job).names()
        return tuple(name for name in names if job.pictures is None or name in job.pictures)

    def runner(self, shot: Rendition, device: Device | None) -> Runner:
        """What makes all of a picture that is to be written, and nothing else."""
        formats = self.formats_of(shot.name)
        made = [FORMATS[f] for f in formats if f != DNG]
        raw = negative_of(shot.chain).step if DNG in formats else None
        return Runner(
            shot.chain,
            device,
            tuple(dict.fromkeys([*self.kept_of(shot), *([raw] if raw else [])])),
            encode=any(f.bits == 8 for f in made),
            final=any(f.bits > 8 for f in made),
        )

    def formats_of(self, name: str) -> tuple[str, ...]:
        """The formats of the picture of that name, see :meth:`RenditionPlan.names`."""
        return ("exr",) if name in MAPS else self.formats

    def keep_of(self, name: str) -> tuple[str, ...]:
        """The steps whose image is written beside the picture of that name, if it has them."""
        return () if name in MAPS else self.keep

    def kept_of(self, shot: Rendition) -> list[str]:
        """The steps of a picture's chain whose image is written too."""
        return [s.name for s in shot.chain.steps if s.name in self.keep_of(shot.name)]

    def check(self, chain: Chain, jobs: Sequence[Job]) -> None:
        """See that the results can be written in these formats, over no input and no other result.

        Raises:
            RequestError: they cannot.
        """
        few = [f for f in self.formats if f != DNG and FORMATS[f].bits < 32]
        if few and chain.result is Kind.RAW:
            raise RequestError(
                f"the chain ends in DN, which {few[0]} cannot hold; "
                "end it with normalize or a later stage, or use --format dng or exr"
            )
        if DNG in self.formats:
            negative_of(chain)  # refuses a chain without a raw
        for burst in {self.burst_of(job) for job in jobs}:
            burst.shots(chain, "")  # refuses a chain of which there is no truth
        endings: dict[str, str] = {}
        for format_ in self.formats:
            other = endings.setdefault(ending_of(format_), format_)
            if other != format_:
                raise RequestError(
                    f"--format {other} and {format_} would both write NAME.{ending_of(format_)}; "
                    "run them into different folders"
                )
        real_folder = os.path.realpath(self.folder)
        inputs = {os.path.realpath(job.path) for job in jobs}
        inside = {path for path in inputs if path.startswith(real_folder + os.sep)}
        makers: dict[str, Job] = {}
        for job in jobs:
            for name in self.pictures_of(job):
                whole = [ending_of(format_) for format_ in self.formats_of(name)]
                for ending in (SIDECAR, *whole, *(f"{step}.exr" for step in self.keep_of(name))):
                    path = f"{job.stem}{name}.{ending}"
                    if inside and os.path.realpath(self.folder / path) in inside:
                        raise RequestError(
                            f"{self.folder / path} is an input and would be overwritten; "
                            "choose another output folder"
                        )
                    if path in makers:
                        raise RequestError(
                            f"{named(makers[path])} and {named(job)} would both write "
                            f"{self.folder / path}; run them into different folders"
                        )
                    makers[path] = job

    def path(self, job: Job, ending: str, name: str = "") -> Path:
        """The output of a job with that ending; ``name`` is one of the burst's."""
        return self.folder / f"{job.stem}{name}.{ending}"

    def check_size(self, source: SourceImage) -> None:
        """See that an image fits into the formats.

        Raises:
            ImageError: it is too large for one.
        """
        if "jpg" in self.formats and max(source.pixels.shape[:2]) > JPEG_MAX_SIDE:
            raise ImageError(f"JPEG holds at most {JPEG_MAX_SIDE} pixels a side; use --format png")

    def _make_folder_of(self, job: Job) -> None:
        """Make the folders between the output folder, which must be there, and a job's files.

        Raises:
            OutputError: the output folder is not there any more.
            ImageError: they cannot be made.
        """
        if not self.folder.is_dir():
            raise OutputError(f"{self.folder}: the folder has gone; {RESUMABLE}")
        place = self.path(job, "").parent
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ImageError(f"{place}: cannot be made: {error.strerror}") from None

    def outputs(self, job: Job, name: str) -> list[Path]:
        """The images of one picture that are there in any case; an image that enters behind a kept
        step has not that one.
        """
        return [self.path(job, ending_of(format_), name) for format_ in self.formats_of(name)]

    def check_folder(self) -> None:
        """See that the output folder can still be written to.

        Raises:
            OutputError: it cannot.
        """
        if reason := trouble_with(self.folder):
            raise OutputError(f"{self.folder}: {reason}; {RESUMABLE}")

    def write(self, job: Job, shot: Rendition, source: SourceImage, result: Result) -> list[Path]:
        """Write the images of one picture; the files.

        Raises:
            ImageError: a file cannot be written.
            OutputError: the output folder is not there any more.
        """
        self._make_folder_of(job)
        chain, camera = shot.chain, shot.chain.camera
        own = Tags(camera.make, camera.model, chain.iso)
        tags, orientation = from_attributes(source.attributes, own)
        how = chain.settings.output.filled({**source.shot, **tags.shot})
        tags = replace(tags, output=how)
        brought = {
            name: source.attributes[name] for name in TAG_ATTRIBUTES if name in source.attributes
        }
        mosaic = chain.result in (Kind.RAW, Kind.MOSAIC)
        turn = 1 if mosaic else orientation  # to turn a mosaic would be to change its pattern
        outputs: list[Path] = []
        for step in (chain.step_named(name) for name in self.kept_of(shot)):
            path = self.path(job, f"{step.name}.exr", shot.name)
            attributes = attributes_of(step, chain, shot.key) | brought
            write_exr(path, result.kept[step.name], step.stage.writes.channels, attributes)
            outputs.append(path)
        for format_ in self.formats_of(shot.name):
            path = self.path(job, ending_of(format_), shot.name)
            if shot.noise:
                assert result.final is not None
                write_exr(path, variance_of(shot.noise, result.final), ("Y",), says_variance(shot))
            elif format_ == DNG:
                negative = negative_of(chain)
                raw = result.kept[negative.step] if negative.step else source.pixels
                write_dng(path, raw, negative, tags, orientation)
            elif FORMATS[format_].ending == "exr":
                assert result.final is not None
                attributes = attributes_of(chain.steps[-1], chain, shot.key) | brought
                if turn != 1:
                    attributes |= {"orientation": "1"}
                half = FORMATS[format_].bits == 16
                image = upright(result.final, turn)
                write_exr(path, image, chain.result.channels, attributes, half)
            else:
                write_display(path, upright(samples(result, FORMATS[format_]), turn), tags)
            outputs.append(path)
        return outputs


def says_variance(shot: Rendition) -> dict[str, str]:
    """What a variance map says of itself: what it is, so that it enters nowhere, and how made."""
    own = attributes_of(shot.noise[-1], shot.whole, shot.key)
    return {**own, "stage": "variance", "kind": "variance"}


def named(job: Job) -> str:
    """A job as an error names it."""
    return f"{job.path} ({job.place})" if job.place else str(job.path)
