"""Plans the files that a run writes for an image: their renditions, formats and names."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from clpipe.base.errors import RequestError
from clpipe.chain.chain import Chain
from clpipe.chain.formats import DNG, FORMATS, NPY, extension_of
from clpipe.chain.rendition import (
    BASELINES,
    DEFAULT_RENDITION,
    FLOATS,
    PICTURES,
    VARIANCE,
    Rendition,
)
from clpipe.chain.request import ResolvedRequest, without_defaults
from clpipe.inputs.companions import CARRIED
from clpipe.inputs.jobs import Job
from clpipe.outputs.carried import png_suffix
from clpipe.outputs.negative import dng_of
from clpipe.outputs.patches import Patches, patch_name, variance_steps
from clpipe.outputs.recipes import recipes, reference_pictures, renditions
from clpipe.outputs.sidecar import SIDECAR
from clpipe.stage import Kind


class RenditionFiles(NamedTuple):
    """The files of a rendition.

    Args:
        sidecar: its sidecar.
        pictures: the files that are always written.
        others: files that may be written. For example, images of steps before ``start_at`` are
            never written.
    """

    sidecar: Path
    pictures: Sequence[Path]
    others: Sequence[Path] = ()


def file_suffix(ending: str, rendition: Rendition, patch: int | None = None) -> str:
    """Return what follows a job's stem in a file name: patch, rendition and extension.

    >>> file_suffix("jpg", Rendition("clean"), 3)
    '_0003.truth_clean.jpg'
    """
    return f"{patch_name(patch)}{rendition.suffix}.{ending}"


@dataclass(frozen=True)
class OutputPlan:
    """The files that a request writes to an output directory.

    Args:
        folder: the output directory.
        request: the request.
    """

    folder: Path
    request: ResolvedRequest

    @property
    def formats(self) -> tuple[str, ...]:
        """The formats of the last image, and of the raw."""
        return self.request.formats

    def _all_renditions(self, frames: int | None) -> tuple[Rendition, ...]:
        """Return all renditions of an image with this number of frames; None is no burst."""
        request = self.request
        frames = request.frames if frames is None else frames
        return renditions(frames, request.truths, request.bracket, request.baselines)

    def renditions_of(self, job: Job) -> tuple[Rendition, ...]:
        """Return the renditions of a job's image."""
        candidates = self._all_renditions(job.frames)
        return (
            candidates
            if job.renditions is None
            else tuple(e for e in candidates if e in job.renditions)
        )

    def needed(self, job: Job, missing: Iterable[Rendition]) -> tuple[Rendition, ...]:
        """Return the renditions to compute, in order.

        They are the missing ones, and the pictures on which missing baselines are measured.
        """
        needed = set(missing)
        for each in tuple(needed):
            if each.role in BASELINES:
                needed |= {*reference_pictures(each)}
        return tuple(each for each in self._all_renditions(job.frames) if each in needed)

    def formats_of(self, rendition: Rendition) -> tuple[str, ...]:
        """Return the formats of a rendition."""
        if rendition.role in BASELINES:  # baselines have no raw
            return tuple(format_ for format_ in self.formats if format_ != DNG)
        return (self.kept_format,) if rendition.role in FLOATS else self.formats

    @property
    def kept_format(self) -> str:
        """The format of images of steps, and of mosaics of floats."""
        return NPY if NPY in self.formats or self.patches else "exr"

    @property
    def patches(self) -> Patches | None:
        """The patches that are written instead of pictures; None writes pictures."""
        request = self.request
        if request.patch is None:
            return None
        return Patches(request.patch, request.patches_per_image, request.augment)

    def kept_steps(self, rendition: Rendition) -> tuple[str, ...]:
        """Return the steps whose images are written with a rendition."""
        if rendition.role in (*FLOATS, *BASELINES):
            return ()
        if rendition.role in PICTURES:
            return self.request.truth_keep
        return self.request.keep

    def request_record(self, request: Mapping[str, Any], rendition: Rendition) -> dict[str, Any]:
        """Return the part of an image's request record that is about one rendition."""
        carry = list(self.request.carry) if self.carries(rendition) else []
        return without_defaults(
            {**request, "keep": list(self.kept_steps(rendition)), "carry": carry}
        )

    def carries(self, rendition: Rendition) -> bool:
        """Return whether carried layers are written with a rendition: only with the first."""
        is_first = rendition.is_first and rendition.ev in (None, *self.request.bracket[:1])
        return bool(self.request.carry) and is_first

    def carried_suffixes(self, rendition: Rendition) -> dict[str, str]:
        """Return the suffixes of carried files: of each layer's PNG, and of the EXR for ""."""
        if not self.carries(rendition):
            return {}
        depths = [each.name for each in self.request.aov_specs() if each.png]
        return {"": f"{CARRIED}.exr", **{name: png_suffix(name) for name in depths}}

    def check(self, chain: Chain, jobs: Sequence[Job]) -> None:
        """Check that the formats can hold the results, and that no file is written twice.

        Raises:
            RequestError: a format cannot hold a result, or a result would overwrite an input or
                another result.
        """
        low_precision = [f for f in self.formats if f not in (DNG, NPY) and FORMATS[f].bits < 32]
        if low_precision and chain.result is Kind.RAW:
            raise RequestError(
                f"the chain ends in DN, but {low_precision[0]} cannot store DN; end the chain "
                "with normalize or a later stage, or use --format dng, npy or exr"
            )
        if DNG in self.formats:
            dng_of(chain)  # rejects a chain without a raw
        for frames in {job.frames for job in jobs}:
            # Reject a chain that cannot produce the requested ground truth.
            recipes(self._all_renditions(frames), chain, "")
        if self.patches:
            self._check_patches(chain)
        endings: dict[str, str] = {}
        for format_ in self.formats:
            other = endings.setdefault(extension_of(format_), format_)
            if other != format_:
                raise RequestError(
                    f"--format {other} and {format_} would both write "
                    f"NAME.{extension_of(format_)}; "
                    "use one run for each, with different output directories"
                )
        self._check_paths(jobs)

    def _check_patches(self, chain: Chain) -> None:
        """Check that patches of a chain's pictures can be written.

        Raises:
            RequestError: they cannot.
        """
        for format_ in self.formats:
            if format_ == DNG or FORMATS[format_].extension == "exr":
                raise RequestError(
                    f"--patch: patches cannot be written as {format_}; use --format npy, png, tif "
                    "or jpg"
                )
        if self.request.baselines:
            raise RequestError(
                "--patch: the noise of a baseline is measured on whole pictures; remove --patch, "
                "or the baseline from --truth"
            )
        if VARIANCE in self.request.truths:
            variance_steps(chain)  # rejects steps that mix the noise of neighbours

    def _check_paths(self, jobs: Sequence[Job]) -> None:
        """Check that no file that may be written is an input or the file of another job.

        Raises:
            RequestError: one is.
        """
        real_folder = os.path.realpath(self.folder)
        inputs = set(map(os.path.realpath, {str(job.path) for job in jobs}))
        inside = {path for path in inputs if path.startswith(real_folder + os.sep)}
        jobs_by_path: dict[str, Job] = {}
        for job in jobs:
            for rendition in self.renditions_of(job):
                sidecar, pictures, others = self._suffixes(rendition)
                for ending in (sidecar, *pictures, *others):
                    path = self.name(job, ending)
                    if inside and os.path.realpath(path) in inside:
                        raise RequestError(
                            f"{path}: this input would be overwritten; choose another output "
                            "directory"
                        )
                    if path in jobs_by_path:
                        raise RequestError(
                            f"{jobs_by_path[path].label} and {job.label} would both write {path}; "
                            "use different output directories, or give them names in a manifest"
                        )
                    jobs_by_path[path] = job

    def path(
        self,
        job: Job,
        ending: str,
        rendition: Rendition = DEFAULT_RENDITION,
        patch: int | None = None,
    ) -> Path:
        """Return the path of a job's file. ``patch`` is the number of a patch."""
        return Path(self.name(job, file_suffix(ending, rendition, patch)))

    def name(self, job: Job, ending: str) -> str:
        """Return the name of a job's file. ``ending`` is what follows the job's stem."""
        return f"{self.folder}/{job.stem}{ending}"

    def files(self, job: Job, rendition: Rendition) -> RenditionFiles:
        """Return the files of a rendition. For a grid of patches, this is only the first patch."""
        sidecar, pictures, others = self._suffixes(rendition)
        return RenditionFiles(
            Path(self.name(job, sidecar)),
            [Path(self.name(job, ending)) for ending in pictures],
            [Path(self.name(job, ending)) for ending in others],
        )

    def _suffixes(self, rendition: Rendition) -> tuple[str, list[str], list[str]]:
        """Return what follows a job's stem in the names of :meth:`files`."""
        if found := self._suffix_cache.get(rendition):
            return found
        numbers = range(self.patches.min_count) if self.patches else (None,)
        formats = [extension_of(format_) for format_ in self.formats_of(rendition)]
        carried = self.carried_suffixes(rendition).values()
        pictures = [file_suffix(each, rendition, n) for n in numbers for each in formats]
        pictures += [file_suffix(each, DEFAULT_RENDITION, n) for n in numbers for each in carried]
        kept = [f"{step}.{self.kept_format}" for step in self.kept_steps(rendition)]
        others = [file_suffix(each, rendition, n) for n in numbers for each in kept]
        found = file_suffix(SIDECAR, rendition), pictures, others
        self._suffix_cache[rendition] = found
        return found

    @cached_property
    def _suffix_cache(self) -> dict[Rendition, tuple[str, list[str], list[str]]]:
        return {}
