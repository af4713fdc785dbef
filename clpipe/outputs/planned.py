"""Which files a run makes of an image: renditions, formats and names; what cannot be is refused."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from clpipe.base.errors import RequestError
from clpipe.chain.chain import Chain
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
from clpipe.inputs.companions import CARRIED
from clpipe.inputs.find import Job
from clpipe.outputs.carried import png_ending
from clpipe.outputs.existing import Existing
from clpipe.outputs.negative import dng_of
from clpipe.outputs.patches import Patches, patch_name, variance_steps
from clpipe.outputs.recipes import RenditionPlan
from clpipe.outputs.sidecar import SIDECAR
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
class PlannedOutputs:
    """The files that a request makes in a folder.

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
            dng_of(chain)  # refuses a chain without a raw
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

    def _endings(self, rendition: Rendition) -> Endings:
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
    def _known_endings(self) -> dict[Rendition, Endings]:
        return {}
