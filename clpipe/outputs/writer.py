"""Writes the pictures of a run: which files, under which names, in which formats."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from clpipe.base.errors import ImageError, OutputError, RequestError
from clpipe.base.files import Stored, keep_names
from clpipe.chain.chain import Chain, Step
from clpipe.chain.formats import DNG, FORMATS, NPY, ending_of
from clpipe.chain.rendition import (
    BASELINES,
    FIRST,
    FLOAT_MOSAICS,
    PICTURES,
    VARIANCE,
    Rendition,
)
from clpipe.chain.request import ResolvedRequest
from clpipe.engine.device import Device
from clpipe.engine.runner import Result, Runner
from clpipe.images.dng import write_dng
from clpipe.images.read import SourceImage
from clpipe.images.tags import Tags, from_attributes, orientation_of, upright
from clpipe.images.write import JPEG_MAX_SIDE, write_display, write_exr, write_npy
from clpipe.inputs.carry import Aovs
from clpipe.inputs.companions import CARRIED
from clpipe.inputs.find import Job
from clpipe.inputs.kept import attributes_of
from clpipe.outputs.carried import png_ending, write_carried
from clpipe.outputs.existing import Existing
from clpipe.outputs.folder import RESUMABLE, write_problem
from clpipe.outputs.negative import negative_of
from clpipe.outputs.parts import parts_of, samples, typed
from clpipe.outputs.patches import Patch, Patches, patch_name, variance_steps
from clpipe.outputs.recipes import Recipe, RenditionPlan
from clpipe.outputs.results import results_of
from clpipe.outputs.sealed import SIDECAR, remove_sidecar
from clpipe.outputs.shot import kept_tags, tags_of
from clpipe.reference.geometry import NO_MARGINS
from clpipe.stage import Kind


class Endings(NamedTuple):
    """What is behind a job's stem in the names of a rendition's files.

    Args:
        sidecar: in that of the sidecar.
        pictures: in those that every such rendition has.
        others: in those of further files that may be written.
    """

    sidecar: str
    pictures: tuple[str, ...]
    others: tuple[str, ...]

    @property
    def every(self) -> tuple[str, ...]:
        """All of them."""
        return (self.sidecar, *self.pictures, *self.others)


def ending_behind(ending: str, rendition: Rendition, patch: int | None = None) -> str:
    """All that is behind a job's stem in the name of a file.

    >>> ending_behind("jpg", Rendition("clean"), 3)
    '_0003.truth_clean.jpg'
    """
    return f"{patch_name(patch)}{rendition.suffix}.{ending}"


@dataclass(frozen=True)
class OutputWriter:
    """Writes the pictures of a request to a folder.

    Args:
        folder: where they go.
        request: what is asked for.
    """

    folder: Path
    request: ResolvedRequest

    @property
    def formats(self) -> tuple[str, ...]:
        """The formats of the last image, and of the raw."""
        return self.request.formats

    def plan_of(self, job: Job) -> RenditionPlan:
        """Which renditions are made of a job's image."""
        frames = self.request.frames if job.frames is None else job.frames
        asked = self.request.truths, self.request.bracket, self.request.baselines
        return RenditionPlan(frames, *asked)

    def renditions_of(self, job: Job) -> tuple[Rendition, ...]:
        """The renditions that are made of a job's image."""
        planned = self.plan_of(job).renditions()
        return tuple(each for each in planned if job.renditions is None or each in job.renditions)

    def runner(self, recipe: Recipe, device: Device | None) -> Runner:
        """A runner that makes all of a rendition that is written, and nothing else."""
        formats, keep = self.formats_of(recipe.rendition), self.keep_of(recipe.rendition)
        results = results_of(recipe.chain, formats, keep)
        if self.request.baselines:
            results = results._replace(final=True)  # to measure its noise
        return Runner(recipe.chain, device, *results)

    def formats_of(self, rendition: Rendition) -> tuple[str, ...]:
        """The formats of a rendition."""
        if rendition.role in BASELINES:  # it has no raw
            return tuple(format_ for format_ in self.formats if format_ != DNG)
        return (self.kept_format,) if rendition.role in FLOAT_MOSAICS else self.formats

    @property
    def kept_format(self) -> str:
        """The format of images of steps, and of mosaics of floats."""
        return NPY if NPY in self.formats or self.patches else "exr"

    @property
    def patches(self) -> Patches | None:
        """Which patches are written in place of pictures."""
        request = self.request
        if request.patch is None:
            return None
        return Patches(request.patch, request.patches_per_image, request.augment)

    def keep_of(self, rendition: Rendition) -> tuple[str, ...]:
        """The steps whose image is written beside a rendition, where it has them."""
        if rendition.role in (*FLOAT_MOSAICS, *BASELINES):
            return ()
        if rendition.role in PICTURES:
            return self.request.truth_keep
        return self.request.keep

    def record_of(self, request: Mapping[str, Any], rendition: Rendition) -> dict[str, Any]:
        """The record of a request as far as it is about one rendition.

        Args:
            request: the record for its image.
            rendition: which it is.
        """
        record = {**request, "keep": list(self.keep_of(rendition))}
        return record if self.carries(rendition) else record | {"carry": []}

    def carries(self, rendition: Rendition) -> bool:
        """Whether layers go along with a rendition: they do with an image's first."""
        is_first = rendition.is_first and rendition.ev in (None, *self.request.bracket[:1])
        return bool(self.request.carry) and is_first

    def _carried_files(
        self, job: Job, rendition: Rendition, patch: int | None = None
    ) -> dict[str, Path]:
        """The files of carried layers: that of all, "", and the PNGs of some by their names."""
        endings = self._carried_endings(rendition).items()
        return {name: self.path(job, ending, patch=patch) for name, ending in endings}

    def _carried_endings(self, rendition: Rendition) -> dict[str, str]:
        """The endings of :meth:`_carried_files`."""
        if not self.carries(rendition):
            return {}
        depths = [each.name for each in self.request.aov_specs() if each.png]
        return {"": f"{CARRIED}.exr", **{name: png_ending(name) for name in depths}}

    def _kept_steps(self, recipe: Recipe) -> list[str]:
        """The steps of a rendition's chain whose image is written, too."""
        keep = self.keep_of(recipe.rendition)
        return [step.name for step in recipe.chain.steps if step.name in keep]

    def check(self, chain: Chain, jobs: Sequence[Job]) -> None:
        """See that the formats can hold the results, and that no file is written twice.

        Raises:
            RequestError: they cannot, or a result would overwrite an input or another result.
        """
        too_small = [f for f in self.formats if f not in (DNG, NPY) and FORMATS[f].bits < 32]
        if too_small and chain.result is Kind.RAW:
            raise RequestError(
                f"the chain ends in DN, which {too_small[0]} cannot hold; "
                "end it with normalize or a later stage, or use --format dng, npy or exr"
            )
        if DNG in self.formats:
            negative_of(chain)  # refuses a chain without a raw
        for plan in {self.plan_of(job) for job in jobs}:
            plan.recipes(chain, "")  # refuses a chain that has no such truth
        if self.patches:
            self._check_patches(chain)
        endings: dict[str, str] = {}
        for format_ in self.formats:
            other = endings.setdefault(ending_of(format_), format_)
            if other != format_:
                raise RequestError(
                    f"--format {other} and {format_} would both write NAME.{ending_of(format_)}; "
                    "run them into different folders"
                )
        self._check_paths(jobs)

    def _check_patches(self, chain: Chain) -> None:
        """See that patches of a chain's pictures can be written.

        Raises:
            RequestError: they cannot.
        """
        for format_ in self.formats:
            if format_ == DNG or FORMATS[format_].ending == "exr":
                raise RequestError(
                    f"--patch: {format_} holds whole images; write patches with --format npy, png, "
                    "tif or jpg"
                )
        if self.request.baselines:
            raise RequestError(
                "--patch: the noise of a baseline is measured on whole pictures; leave one of "
                "--patch and --truth out"
            )
        if VARIANCE in self.request.truths:
            variance_steps(chain)  # refuses steps that mix the noise of neighbours

    def _check_paths(self, jobs: Sequence[Job]) -> None:
        """See that no file that may be written is an input or the file of another job.

        Raises:
            RequestError: one is.
        """
        real_folder = os.path.realpath(self.folder)
        inputs = set(map(os.path.realpath, {str(job.path) for job in jobs}))
        inside = {path for path in inputs if path.startswith(real_folder + os.sep)}
        makers: dict[str, Job] = {}
        for job in jobs:
            for rendition in self.renditions_of(job):
                for path in (self.name(job, ending) for ending in self._endings(rendition).every):
                    if inside and os.path.realpath(path) in inside:
                        raise RequestError(
                            f"{path} is an input and would be overwritten; "
                            "choose another output folder"
                        )
                    if path in makers:
                        raise RequestError(
                            f"{makers[path].label} and {job.label} would both write {path}; "
                            f"run them into different folders, or name them in a manifest"
                        )
                    makers[path] = job

    def path(
        self, job: Job, ending: str, rendition: Rendition = FIRST, patch: int | None = None
    ) -> Path:
        """The file of a job with an ending; ``patch`` is the number of a patch of the rendition."""
        return Path(self.name(job, ending_behind(ending, rendition, patch)))

    def name(self, job: Job, ending: str) -> str:
        """The name of a job's file; ``ending`` is all that is behind the job's stem."""
        return f"{self.folder}/{job.stem}{ending}"

    def check_size(self, source: SourceImage, chain: Chain) -> None:
        """See that what a chain makes of an image fits into the formats.

        Raises:
            ImageError: it is too large for one.
        """
        size = chain.size(*source.pixels.shape[1::-1])
        if "jpg" in self.formats and max(size) > JPEG_MAX_SIDE:
            raise ImageError(f"JPEG holds at most {JPEG_MAX_SIDE} pixels a side; use --format png")

    def existing(self, job: Job, rendition: Rendition) -> Existing:
        """The files of a rendition. A kept image of a step before ``start_at`` is
        never written, so kept images need not be there. Of a grid of patches, whose number follows
        from the image, the first is named.
        """
        endings = self._endings(rendition)
        pictures, others = (
            [Path(self.name(job, ending)) for ending in own]
            for own in (endings.pictures, endings.others)
        )
        return Existing(Path(self.name(job, endings.sidecar)), pictures, others)

    def _endings(self, rendition: Rendition) -> "Endings":
        """What is behind a job's stem in the names of a rendition's files."""
        if found := self._known_endings.get(rendition):
            return found
        numbers = range(self.patches.least) if self.patches else (None,)
        formats = [ending_of(format_) for format_ in self.formats_of(rendition)]
        kept = [f"{step}.{self.kept_format}" for step in self.keep_of(rendition)]
        pictures = [ending_behind(each, rendition, n) for n in numbers for each in formats]
        for n in numbers:
            carried = self._carried_endings(rendition).values()
            pictures += [ending_behind(each, FIRST, n) for each in carried]
        others = [ending_behind(each, rendition, n) for n in numbers for each in kept]
        found = Endings(ending_behind(SIDECAR, rendition), tuple(pictures), tuple(others))
        self._known_endings[rendition] = found
        return found

    @cached_property
    def _known_endings(self) -> "dict[Rendition, Endings]":
        return {}

    def check_folder(self) -> None:
        """See that the output folder can still be written to.

        Raises:
            OutputError: it cannot.
        """
        if reason := write_problem(self.folder):
            raise OutputError(f"{self.folder}: {reason}; {RESUMABLE}")

    @staticmethod
    def picture_orientation(source: SourceImage, chain: Chain) -> int:
        """EXIF's orientation by which a picture is turned; a mosaic, whose pattern would change, is
        not turned.

        Raises:
            ImageError: the attributes of the source are damaged.
        """
        is_mosaic = chain.result in (Kind.RAW, Kind.MOSAIC)
        return 1 if is_mosaic else orientation_of(source.attributes)

    def write(
        self,
        job: Job,
        recipe: Recipe,
        source: SourceImage,
        result: Result,
        carried: Aovs | None = None,
        patches: Sequence[Patch] = (),
    ) -> dict[Path, Stored]:
        """Write the images of one rendition, or of patches of it.

        Args:
            job: the image.
            recipe: of the picture.
            source: the image, as it was loaded.
            result: what its :meth:`runner` made of it.
            carried: layers that are written beside it.
            patches: of which the result is; () is all of the picture.

        Returns:
            The files.

        Raises:
            ImageError: a file cannot be written.
            OutputError: the output folder has gone.
        """
        self._make_folder_of(job)
        # A new picture beside an old sidecar would look like one that somebody has changed.
        remove_sidecar(self.path(job, SIDECAR, recipe.rendition))
        outputs: dict[Path, Stored] = {}
        for number, part in parts_of(recipe, result, patches):
            outputs |= self._write(job, recipe, source, part, number)
        if carried:
            own: list[tuple[int | None, Aovs]]
            own = [(n, carried.changed(patch.cut_out)) for n, patch in enumerate(patches)]
            for number, layers in own or [(None, carried)]:
                for layer, path in self._carried_files(job, recipe.rendition, number).items():
                    outputs[path] = write_carried(path, layers, layer)
        return outputs

    def _write(
        self, job: Job, recipe: Recipe, source: SourceImage, result: Result, patch: int | None
    ) -> dict[Path, Stored]:
        """Write the images of one rendition, or of a patch of it, by its number; see :meth:`write`.

        The last image of a variance map is the variance.
        """
        chain, rendition, camera = recipe.chain, recipe.rendition, recipe.chain.camera
        tags, source_orientation = from_attributes(
            source.attributes, Tags(camera.make, camera.model, chain.iso)
        )
        tags = tags_of(chain, source, tags, result.estimates)
        if patch is not None:  # which has not the width of the sensor
            tags = replace(tags, sensor_width=None)
        orientation = self.picture_orientation(source, chain) if patch is None else 1
        outputs: dict[Path, Stored] = {}
        whose = recipe.key, rendition.frame
        for step in (chain.step_named(name) for name in self._kept_steps(recipe)):
            path = self.path(job, f"{step.name}.{self.kept_format}", rendition, patch)
            if self.kept_format == NPY:
                outputs[path] = write_npy(
                    path, typed(result.kept[step.name], step.stage.writes, _white(step))
                )
                continue
            carried_tags = kept_tags(chain, step, source, tags)
            attributes = attributes_of(step, chain, *whose) | carried_tags
            channels = step.stage.writes.channels
            beyond = NO_MARGINS if step.method.geometry() else step.method.margins
            outputs[path] = write_exr(
                path, result.kept[step.name], channels, attributes, margins=beyond
            )
        for format_ in self.formats_of(rendition):
            path = self.path(job, ending_of(format_), rendition, patch)
            if recipe.noise and format_ != NPY:
                assert result.final is not None
                attributes = variance_attributes(recipe)
                outputs[path] = write_exr(path, result.final, ("Y",), attributes)
            elif format_ == NPY:
                assert result.final is not None
                image = upright(result.final, orientation)
                outputs[path] = write_npy(path, typed(image, chain.result, _white(chain.steps[-1])))
            elif format_ == DNG:
                negative = negative_of(chain)
                raw = result.kept[negative.step] if negative.step else source.pixels
                outputs[path] = write_dng(path, raw, negative, tags, source_orientation)
            elif FORMATS[format_].ending == "exr":
                assert result.final is not None
                carried_tags = kept_tags(chain, chain.steps[-1], source, tags)
                attributes = attributes_of(chain.steps[-1], chain, *whose) | carried_tags
                if orientation != 1:
                    attributes |= {"orientation": "1"}
                half = FORMATS[format_].bits == 16
                image = upright(result.final, orientation)
                outputs[path] = write_exr(path, image, chain.result.channels, attributes, half)
            else:
                pixels = upright(samples(result, FORMATS[format_]), orientation)
                outputs[path] = write_display(path, pixels, tags)
        return outputs

    def _make_folder_of(self, job: Job) -> None:
        """Make the folders between the output folder, which must be there, and a job's files.

        Raises:
            OutputError: the output folder has gone.
            ImageError: they cannot be made.
        """
        if not self.folder.is_dir():
            raise OutputError(f"{self.folder}: the folder has gone; {RESUMABLE}")
        folder = self.path(job, "").parent
        try:
            if folder.is_dir():
                return
            folder.mkdir(parents=True, exist_ok=True)
            for place in folder.relative_to(self.folder).parents:
                keep_names(self.folder / place)
        except OSError as error:
            raise ImageError(f"{folder}: cannot be made: {error.strerror}") from None


def _white(step: Step) -> float | None:
    """The white level of a step's image in DN; of DN that a curve has made fewer, their own."""
    context = step.method.next_context(step.context)
    return context.knots[-1][1] if context.knots else context.white_level


def variance_attributes(recipe: Recipe) -> dict[str, str]:
    """The attributes of a variance map; by their kind it can enter no chain."""
    own = attributes_of(recipe.noise[-1], recipe.whole, recipe.key, recipe.rendition.frame)
    return {**own, "stage": "variance", "kind": "variance"}
