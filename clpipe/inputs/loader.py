"""Loads images, and makes the chain for each: renders, camera raws, dumps and kept images."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.digests import stamp_of
from clpipe.base.errors import ImageError, KindError, NoPictureError, RequestError
from clpipe.base.reading import check_unchanged
from clpipe.base.urls import listed_stamps, may_be_url
from clpipe.chain.chain import Chain
from clpipe.chain.entering import prepare_image, with_bands
from clpipe.chain.exposures import exposures_of
from clpipe.chain.identity import image_key
from clpipe.chain.isos import check_cameras
from clpipe.chain.keys import RENDER
from clpipe.chain.making import entry_kind
from clpipe.chain.methods import base_name, stage_named
from clpipe.chain.overscan import overscan_step_count
from clpipe.chain.registry import stage_in
from clpipe.chain.request import Request
from clpipe.chain.settings import Settings
from clpipe.images.claims import MemoryClaim, bands_in, claim_of, mosaic_claim
from clpipe.images.pixels import DEFAULT_MAX_PIXELS
from clpipe.images.raw import RAW_SUFFIXES
from clpipe.images.read import (
    PICTURE_SUFFIXES,
    RENDER_SUFFIXES,
    ReadOptions,
    SourceImage,
    read_source,
)
from clpipe.images.video_reading import VIDEO_SUFFIXES
from clpipe.inputs.carry import CarriedLayers, carry, merge_moments
from clpipe.inputs.carry_panorama import carry_panorama
from clpipe.inputs.jobs import Job
from clpipe.inputs.kept import KeptLoader, kind_message
from clpipe.inputs.layers import read_step_layer
from clpipe.inputs.manifest import check_rows
from clpipe.inputs.panoramas import (
    CUBE_MAP,
    check_subframes,
    group_panoramas,
    read_panorama,
    wide_lens_of,
)
from clpipe.inputs.raw import RawImage, RawLoader, may_be_dump
from clpipe.inputs.sequences import check_same_layer, picture_layer
from clpipe.inputs.subframes import average, exposures, shutter_of
from clpipe.reference.geometry import Margins
from clpipe.stage import ImageLayer, Kind, Span, StageRole
from clpipe.stages.shutter import Rows


@dataclass(frozen=True)
class LoadedImage:
    """An image, with its chain and its image key. The image contains its warnings."""

    chain: Chain
    source: SourceImage
    key: str


@dataclass(frozen=True)
class ImageLoader:
    """Loads the images of a request.

    Args:
        request: the request.
        folder: the folder that file names in attributes are relative to; None is the working
            directory.
    """

    request: Request
    folder: Path | None = None

    def for_job(self, job: Job, draw_key: str = "") -> "ImageLoader":
        """Return the loader for one job, or this loader if the job has no settings of its own.

        Args:
            job: the job.
            draw_key: the key that seeds random draws; "" is the job's key.

        Raises:
            ImageError: the job has a problem, or its values are not allowed.
        """
        job.check()
        return self._for_values(job, draw_key)

    def has_own_values(self, job: Job) -> bool:
        """Return whether a job has settings of its own."""
        return bool(job.values) or self.has_draws

    def _for_values(self, job: Job, draw_key: str = "") -> "ImageLoader":
        if not self.has_own_values(job):
            return self
        return ImageLoader(self.request.for_image(draw_key or job.key, job.values), self.folder)

    @cached_property
    def settings(self) -> Settings:
        """The settings of an image without embedded settings."""
        return self.request.settings()

    @cached_property
    def has_draws(self) -> bool:
        """Whether some settings are drawn at random for each image."""
        return bool(self.settings.draws)

    @cached_property
    def chain(self) -> Chain:
        """The chain of an image without embedded settings."""
        return self.request.chain_from(self.settings, self.request.start_at)

    @cached_property
    def reads(self) -> Kind:
        """The kind of image that the chain reads, except for raws."""
        start_at = self.request.start_at
        if start_at is None:
            return entry_kind(self.settings)
        stage = stage_named("--start-at", base_name(start_at))
        try:
            return self.chain.source if stage.also_reads else stage.reads
        except RequestError:  # only the chain in a kept image's attributes has the stage
            return stage.reads

    @property
    def kept(self) -> KeptLoader | None:
        """The loader of kept images; None if chains start at their first step."""
        return None if self.request.start_at is None else KeptLoader(self.request, self.folder)

    @cached_property
    def reads_overscan(self) -> bool:
        """Whether the overscan of renders is read."""
        return self.kept is not None or overscan_step_count(self.chain) > 0

    @cached_property
    def raw(self) -> RawLoader:
        """The loader of raws and dumps."""
        return RawLoader(self.request, self.settings.dump_format)

    def endings(self) -> tuple[str, ...]:
        """Return the extensions of the files that are taken from folders."""
        if self.request.start_at is None and self.reads is Kind.DISPLAY:
            return (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES)
        pictures = (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES) if self.request.transfer else ()
        return (*RENDER_SUFFIXES, *pictures, *RAW_SUFFIXES)

    def first_chain(self, jobs: Sequence[Job]) -> Chain:
        """Return the chain of the first image, to reject a wrong request before the run starts.

        Raises:
            RequestError: the chain cannot be made.
        """
        first = next((job for job in jobs if not job.problem), jobs[0])
        loader, path = self._for_values(first), first.path
        is_raw = self.raw.is_raw
        if all(is_raw(job.path) for job in jobs):
            return loader.raw.first_chain(path)
        if loader.kept:
            return loader.kept.first_chain(path)
        return with_bands(loader.chain, bands_in(path, self.request.layer))

    def exposures(self, jobs: Sequence[Job], in_sequences: bool = False) -> list[Job]:
        """Return the jobs, with the files of one exposure or panorama joined into one job.

        Args:
            jobs: a job for each file.
            in_sequences: whether sub-frames are in the order of the numbers in their names.

        Raises:
            RequestError: the files do not fit together.
        """
        if self.kept:
            return list(jobs)
        wide, shutter = wide_lens_of(self.settings), shutter_of(self.settings)
        if wide and shutter and shutter.light_layer:
            raise RequestError(
                f"{stage_in(StageRole.SHUTTER).name}.flicker_layer: found "
                f"{shutter.light_layer}, but panoramas have no light layers; remove this "
                "parameter to make all light flicker"
            )
        return group_panoramas(exposures(jobs, self.settings, in_sequences), wide)

    def check(self, jobs: Sequence[Job]) -> None:
        """Check that the values of single images are allowed.

        Raises:
            RequestError: they are not; the message names the row.
        """
        carries = self.raw.is_raw if self.kept is None else lambda path: True
        # Values from a file of cameras were checked when they were read.
        if rows := [job for job in jobs if job.location or job.values.keys() - {RENDER}]:
            check_rows(rows, self.settings, carries)
        checked = {id(job) for job in rows}
        if not all(id(job) in checked or carries(job.path) for job in jobs):
            check_cameras(self.settings)

    def claim(self, job: Job) -> MemoryClaim:
        """Return the size and memory that a job's headers claim, without reading pixels.

        The claim is 0 if the file has too many pixels to be read. For a file that cannot be opened,
        it is one pixel per byte, and 0 at a URL that was not listed, so that nothing is requested.
        """
        max_pixels = self.request.max_pixels or DEFAULT_MAX_PIXELS
        dump = self.settings.dump_format
        if dump and may_be_dump(job.path):
            claim = mosaic_claim(dump.width, dump.height)
        else:
            mosaic = len(self.reads.channels) == 1
            found = claim_of(job.path, mosaic, self.request.layer)
            is_here = not may_be_url(job.path) or job.path.exists()
            known = [stamp_of(job.path)] if is_here else [*listed_stamps([job.path]).values()]
            size = known[0][0] if known else 0
            claim = found or mosaic_claim(min(size, max_pixels), 1)
        if claim.width * claim.height > max_pixels:
            return mosaic_claim(0, 0)
        files = len(job.paths) if job.is_panorama else 1
        return MemoryClaim(
            claim.width, claim.height * files, claim.image * files, claim.reading * files
        )

    def has_readable_header(self, job: Job) -> bool:
        """Return whether the header of a job's file can be read."""
        is_dump = self.settings.dump_format is not None and may_be_dump(job.path)
        return is_dump or claim_of(job.path) is not None

    def read(self, job: Job) -> SourceImage:
        """Return the image of a job.

        Raises:
            ImageError: it cannot be read, has another kind or size than expected, or changes while
                it is read.
        """
        is_render = self.kept is None and not self.raw.is_raw(job.path)
        wide = wide_lens_of(self.settings) if is_render else None
        if wide and (job.is_panorama or not job.subframes):
            return read_panorama(job, self._read, wide)
        shutter = self.shutter(job)
        if shutter:
            resolved = shutter.with_defaults(exposure_time=self.chain.optics.exposure_time)
            exposures = exposures_of(self.chain)
            spans = exposures.spans if exposures else (Span(),)
            source = average(job, self._read, resolved, spans)
            if wide:
                check_subframes(job, source, wide, resolved.line_time > 0)
        else:
            with check_unchanged(job.path):
                source = self._read(job.path)
        if source.envmap == CUBE_MAP:
            raise ImageError(
                f"{job.path}: this is a cube map, not a picture. To view it through a wide lens, "
                f"add --set {stage_in(StageRole.VIEW).name}.method=kannala_brandt"
            )
        width, height = source.margins.frame_size(*source.pixels.shape[1::-1])
        if job.size and job.size != (width, height):
            raise ImageError(
                f"{job.path}: this image has {width}x{height} pixels, but its camera in --poses "
                f"has {job.size[0]}x{job.size[1]}. Correct the camera's size, or render at that "
                "size"
            )
        if is_render and job.first and not self.request.layer:
            check_same_layer(job.path, source.layer, job.first)
        return source

    def shutter(self, job: Job) -> Rows | None:
        """Return the shutter that combines a job's files or layers, or None for a single layer."""
        shutter = shutter_of(self.settings)
        is_render = self.kept is None and not self.raw.is_raw(job.path)
        is_lit = shutter is not None and bool(shutter.light_layer) and is_render
        return shutter if job.subframes or is_lit else None

    def _read(self, path: Path, layer: str | None = None) -> SourceImage:
        request = self.request
        try:
            if self.raw.is_raw(path):
                return self.raw.read(path)
            options = ReadOptions(
                layer or request.layer,
                request.max_pixels or DEFAULT_MAX_PIXELS,
                request.transfer,
                self.reads_overscan,
            )
            return read_source(path, self.reads, options)
        except ImageError as error:
            if type(error) is ImageError:  # a subclass says more
                error.error_class = "damaged" if any(stamp_of(path)) else "not_found"
            raise

    def enter(self, job: Job, source: SourceImage) -> LoadedImage | None:
        """Return an image with the chain for it.

        A source that was entered before stays as it is, with the layers that steps read. Return
        None for a kept image from a folder that was not kept right before ``start_at``.

        Raises:
            ImageError: the image cannot enter the chain, or lacks a layer that a step reads.
            RequestError: the chain cannot be made.
        """
        loaded = self._enter_without_layers(job, source)
        if loaded is None:
            return None
        source, request = loaded.source, self.request
        carried, max_pixels = request.aov_specs(), request.max_pixels or DEFAULT_MAX_PIXELS

        def layer(chain: Chain, step: str, width: int, height: int, margins: Margins) -> ImageLayer:
            return source.layers.get(step) or read_step_layer(
                *(job.at("middle"), source.layer, chain, step, width, height, margins, carried),
                max_pixels,
            )

        around = source.panorama
        chain = loaded.chain
        if source.wavelengths != chain.settings.render.wavelengths:  # a call costs more
            chain = with_bands(chain, source.wavelengths)
        entry_ = prepare_image(chain, source.pixels, source.margins, layer, source.shot, around)
        if entry_.pixels is source.pixels and not (
            entry_.margins or entry_.layers or entry_.warnings
        ):
            return LoadedImage(entry_.chain, source, loaded.key)
        later = source.later
        if entry_.margins != source.margins:
            later = tuple(np.ascontiguousarray(source.margins.cropped(each)) for each in later)
        source = replace(
            source,
            pixels=entry_.pixels,
            later=later,
            margins=entry_.margins,
            layers=entry_.layers,
            warnings=tuple(dict.fromkeys((*source.warnings, *entry_.warnings))),
        )
        return LoadedImage(entry_.chain, source, loaded.key)

    def _enter_without_layers(self, job: Job, source: SourceImage) -> LoadedImage | None:
        """Return an image with its chain like :meth:`enter`, but without reading layers."""
        key = image_key(job.key, source.sha256)
        if isinstance(source, RawImage):
            chain, source = self.raw.enter(job.path, source)
            return LoadedImage(chain, source, key)
        if self.kept:
            entered = self.kept.enter(job.path, source, key, job.named_by_user)
            return LoadedImage(*entered) if entered else None
        if stage := source.attributes.get("stage"):
            warning = (
                f"this image was kept after {stage}, but is processed as a render; to resume from "
                "it, use --start-at"
            )
            source = replace(source, warnings=tuple(dict.fromkeys((*source.warnings, warning))))
        return LoadedImage(self.chain, source, key)

    def carried_layers(self, job: Job, loaded: LoadedImage, orientation: int = 1) -> CarriedLayers:
        """Return the carried layers of a job's picture, at the requested moments.

        Args:
            job: the image's job.
            loaded: the image that :meth:`enter` returned.
            orientation: the EXIF orientation that is applied to the picture at the end.

        Raises:
            ImageError: a layer is missing, or does not fit the image.
        """
        request = self.request
        max_pixels = request.max_pixels or DEFAULT_MAX_PIXELS
        layers = request.aov_specs()
        moments = ("middle", "start", "end") if request.truth_at == "all" else (request.truth_at,)
        arguments = loaded.source, loaded.chain, layers, max_pixels, orientation
        if loaded.source.panorama and layers:
            return carry_panorama(job.paths, *arguments)
        if not job.subframes:
            return carry([job.path], *arguments)
        by_moment = {
            moment: carry(job.paths if moment == "rows" else [job.at(moment)], *arguments)
            for moment in moments
        }
        return merge_moments(by_moment, named=len(moments) > 1)

    def is_skipped(self, job: Job, error: Exception) -> bool:
        """Return whether an image that cannot be used is skipped, because it is from a folder."""
        if job.named_by_user:
            return False
        if isinstance(error, NoPictureError):  # a frame has a picture if the first one has
            return job.first in (None, job.path) or picture_layer(job.first) is None
        return isinstance(error, KindError) and self.kept is not None

    def error_text(self, job: Job, error: Exception) -> str:
        """Return the message of an error, with the name of the file and a way to correct it."""
        if isinstance(error, KindError):
            return kind_message(error, self.chain, self.request.start_at)
        message = str(error) or "there is not enough memory for it"
        message = message.replace(str(job.path), job.display_name)
        return message if job.display_name in message else f"{job.display_name}: {message}"

    def __getstate__(self) -> dict[str, Any]:
        # Cached values are not pickled, because they may contain classes of stage files.
        return {each.name: getattr(self, each.name) for each in fields(self)}
