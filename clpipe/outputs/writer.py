"""Writes the pictures of a run, as :mod:`clpipe.outputs.planned` has them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from clpipe.base.errors import ImageError, OutputError
from clpipe.base.files import Stored, keep_names
from clpipe.chain.chain import Chain, Step
from clpipe.chain.formats import DNG, FORMATS, NPY, ending_of
from clpipe.engine.device import Device
from clpipe.engine.runner import Result, Runner
from clpipe.images.dng import write_dng
from clpipe.images.read import SourceImage
from clpipe.images.tags import Tags, from_attributes, orientation_of, upright
from clpipe.images.write import JPEG_MAX_SIDE, write_display, write_exr, write_npy
from clpipe.inputs.carry import Aovs
from clpipe.inputs.find import Job
from clpipe.inputs.kept import attributes_of
from clpipe.outputs.carried import write_carried
from clpipe.outputs.folder import RESUMABLE, write_problem
from clpipe.outputs.negative import negative_of
from clpipe.outputs.parts import parts_of, samples, typed
from clpipe.outputs.patches import Patch
from clpipe.outputs.planned import PlannedOutputs
from clpipe.outputs.recipes import Recipe
from clpipe.outputs.results import results_of
from clpipe.outputs.shot import kept_tags, shown_tags, tags_of
from clpipe.outputs.sidecar import SIDECAR, remove_sidecar
from clpipe.reference.geometry import NO_MARGINS
from clpipe.stage import Kind


@dataclass(frozen=True)
class OutputWriter(PlannedOutputs):
    """Writes the pictures of a request to a folder."""

    def runner(self, recipe: Recipe, device: Device | None) -> Runner:
        """A runner that makes all of a rendition that is written, and nothing else."""
        formats, keep = self.formats_of(recipe.rendition), self.keep_of(recipe.rendition)
        results = results_of(recipe.chain, formats, keep)
        if self.request.baselines:
            results = results._replace(final=True)  # to measure its noise
        return Runner(recipe.chain, device, *results)

    def _kept_steps(self, recipe: Recipe) -> list[str]:
        """The steps of a rendition's chain whose image is written, too."""
        keep = self.keep_of(recipe.rendition)
        return [step.name for step in recipe.chain.steps if step.name in keep]

    def check_size(self, source: SourceImage, chain: Chain) -> None:
        """See that what a chain makes of an image fits into the formats.

        Raises:
            ImageError: it is too large for one.
        """
        size = chain.size(*source.pixels.shape[1::-1])
        if "jpg" in self.formats and max(size) > JPEG_MAX_SIDE:
            raise ImageError(f"JPEG holds at most {JPEG_MAX_SIDE} pixels a side; use --format png")

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
                if negative.step:
                    tags_of_raw = shown_tags(chain.through([negative.step]), source, tags)
                else:
                    tags_of_raw = tags
                outputs[path] = write_dng(path, raw, negative, tags_of_raw, source_orientation)
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
                outputs[path] = write_display(path, pixels, shown_tags(chain, source, tags))
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
