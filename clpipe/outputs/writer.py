"""Writes the files that :mod:`clpipe.outputs.plan` names."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path

import numpy as np

from clpipe.base.errors import ImageError, OutputError
from clpipe.base.files import Stored, sync_folder
from clpipe.base.types import Array, Floats
from clpipe.chain.chain import Chain, Step
from clpipe.chain.formats import DNG, FORMATS, NPY, Format, extension_of
from clpipe.chain.rendition import LIGHTS, XYZ
from clpipe.engine.runner import Result
from clpipe.images.dng import write_dng
from clpipe.images.read import SourceImage
from clpipe.images.tags import Tags, from_attributes, orientation_of, upright
from clpipe.images.write import JPEG_MAX_SIDE, write_display, write_exr, write_npy
from clpipe.inputs.carry import CarriedLayers
from clpipe.inputs.jobs import Job
from clpipe.inputs.kept import attributes_of
from clpipe.outputs.carried import write_carried
from clpipe.outputs.folder import RESUMABLE, write_problem
from clpipe.outputs.negative import negative_of
from clpipe.outputs.patches import Patch, variance_at
from clpipe.outputs.plan import OutputPlan
from clpipe.outputs.recipes import Recipe, required_results
from clpipe.outputs.shot import kept_tags, tags_after, tags_of
from clpipe.outputs.sidecar import SIDECAR, remove_sidecar
from clpipe.reference.curve import to_16_bit
from clpipe.reference.geometry import NO_MARGINS, Margins
from clpipe.stage import Kind


@dataclass(frozen=True)
class OutputWriter(OutputPlan):
    """Writes the pictures of a request to a folder."""

    def results(self, recipe: Recipe) -> tuple[tuple[str, ...], bool, bool]:
        """Return the results that the files of a rendition require.

        Returns:
            The steps whose images are required, whether the last image is required in 8 bits, and
            whether it is required in floats.
        """
        formats, keep = self.formats_of(recipe.rendition), self.kept_steps(recipe.rendition)
        steps, encode, final = required_results(recipe.chain, formats, keep)
        # The noise of baselines is measured on the final picture.
        final |= bool(self.request.baselines)
        return steps, encode, final

    def check_size(self, source: SourceImage, chain: Chain) -> None:
        """Check that the picture of an image fits into the formats.

        Raises:
            ImageError: it is too large for a format.
        """
        size = chain.size(*source.pixels.shape[1::-1])
        if "jpg" in self.formats and max(size) > JPEG_MAX_SIDE:
            raise ImageError(
                f"the picture of this image would have {size[0]}x{size[1]} pixels, but JPEG "
                f"allows at most {JPEG_MAX_SIDE} per side; use --format png"
            )

    def check_folder(self) -> None:
        """Check that the output directory can still be written to.

        Raises:
            OutputError: it cannot.
        """
        if reason := write_problem(self.folder):
            raise OutputError(f"{self.folder}: {reason}; {RESUMABLE}")

    @staticmethod
    def picture_orientation(source: SourceImage, chain: Chain) -> int:
        """Return the EXIF orientation that rotates a picture upright.

        A mosaic is not rotated, because its pattern would change.

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
        carried: CarriedLayers | None = None,
        patches: Sequence[Patch] = (),
    ) -> dict[Path, Stored]:
        """Write the images of one rendition, or of patches of it.

        Args:
            job: the image.
            recipe: the recipe of the picture.
            source: the image, as it was loaded.
            result: the result of :meth:`runner`.
            carried: layers to write next to the picture.
            patches: the patches that the result contains; () for the whole picture.

        Returns:
            The files, with their size and digest.

        Raises:
            ImageError: a file cannot be written.
            OutputError: the output directory was removed.
        """
        self._make_folder_of(job)
        # A new picture with an old sidecar would look like a picture that somebody changed.
        remove_sidecar(self.path(job, SIDECAR, recipe.rendition))
        outputs: dict[Path, Stored] = {}
        for number, patch in numbered(patches):
            part = patch_result(result, recipe, number, patch)
            outputs |= self._write(job, recipe, source, part, number)
        if carried:
            for number, patch in numbered(patches):
                layers = carried.map_arrays(patch.crop) if patch else carried
                for layer, ending in self.carried_suffixes(recipe.rendition).items():
                    path = self.path(job, ending, patch=number)
                    outputs[path] = write_carried(path, layers, layer)
        return outputs

    def _write(
        self, job: Job, recipe: Recipe, source: SourceImage, result: Result, patch: int | None
    ) -> dict[Path, Stored]:
        """Write the images of one rendition, or of the patch with a number; see :meth:`write`.

        For a variance map, the result's last image is the variance.
        """
        chain, rendition, camera = recipe.chain, recipe.rendition, recipe.chain.camera
        tags, source_orientation = from_attributes(
            source.attributes, Tags(camera.make, camera.model, chain.iso)
        )
        tags = tags_of(chain, source, tags, result.estimates)
        if patch is not None:  # a patch is not as wide as the sensor
            tags = replace(tags, sensor_width=None)
        orientation = self.picture_orientation(source, chain) if patch is None else 1

        def write_floats(
            path: Path, image: Floats, step: Step, turn: int, half: bool, margins: Margins
        ) -> Stored:
            image, kind = upright(image, turn), step.stage.writes
            if path.suffix == f".{NPY}":
                return write_npy(path, to_npy_type(image, kind, _white_level(step)))
            if rendition.role in LIGHTS:  # a render like any other
                return write_exr(path, image, "XYZ" if rendition.role == XYZ else "RGB", {})
            attributes = attributes_of(step, chain, recipe.key, rendition.frame)
            attributes |= kept_tags(chain, step, source, tags)
            attributes |= {"orientation": "1"} if turn != 1 else {}
            return write_exr(path, image, kind.channels, attributes, half, margins)

        outputs: dict[Path, Stored] = {}
        keep = self.kept_steps(rendition)
        for step in (step for step in chain.steps if step.name in keep):
            path = self.path(job, f"{step.name}.{self.kept_format}", rendition, patch)
            margins = NO_MARGINS if step.method.geometry() else step.method.margins
            outputs[path] = write_floats(path, result.kept[step.name], step, 1, False, margins)
        for format_ in self.formats_of(rendition):
            ending, final = extension_of(format_), result.final
            path = self.path(job, ending, rendition, patch)
            if format_ == DNG:
                negative, tags_of_raw = negative_of(chain), tags
                raw = result.kept[negative.step] if negative.step else source.pixels
                if negative.step:
                    tags_of_raw = tags_after(chain.up_to([negative.step]), source, tags)
                outputs[path] = write_dng(path, raw, negative, tags_of_raw, source_orientation)
            elif ending not in (NPY, "exr"):
                pixels = upright(display_samples(result, FORMATS[format_]), orientation)
                outputs[path] = write_display(path, pixels, tags_after(chain, source, tags))
            elif recipe.noise and format_ != NPY:
                assert final is not None
                outputs[path] = write_exr(path, final, ("Y",), variance_attributes(recipe))
            else:
                assert final is not None
                half = FORMATS[format_].bits == 16
                last = chain.steps[-1], orientation, half, NO_MARGINS
                outputs[path] = write_floats(path, final, *last)
        return outputs

    def shared_place(self, sidecar: Path) -> Path:
        """Return a path next to the file that a sidecar shares with others of its run."""
        return sidecar

    def _make_folder_of(self, job: Job) -> None:
        """Create the folders between the output directory, which must exist, and a job's files.

        Raises:
            OutputError: the output directory was removed.
            ImageError: a folder cannot be created.
        """
        if not self.folder.is_dir():
            raise OutputError(f"{self.folder}: this directory was removed; {RESUMABLE}")
        folder = self.path(job, "").parent
        try:
            if folder.is_dir():
                return
            folder.mkdir(parents=True, exist_ok=True)
            for parent in folder.relative_to(self.folder).parents:
                sync_folder(self.folder / parent)
        except OSError as error:
            raise ImageError(f"{folder}: this folder cannot be created: {error.strerror}") from None


def _white_level(step: Step) -> float | None:
    """Return the white level of a step's image in DN, after companding if there is any."""
    context = step.method.next_context(step.context)
    return context.knots[-1][1] if context.knots else context.white_level


def variance_attributes(recipe: Recipe) -> dict[str, str]:
    """Return the attributes of a variance map. Their kind prevents its use as an input."""
    attributes = attributes_of(
        recipe.noise[-1], recipe.full_chain, recipe.key, recipe.rendition.frame
    )
    return {**attributes, "stage": "variance", "kind": "variance"}


def numbered(patches: Sequence[Patch]) -> list[tuple[int, Patch]] | list[tuple[None, None]]:
    """Return patches with their numbers, or one pair of None for the picture."""
    return [*enumerate(patches)] or [(None, None)]


def patch_result(result: Result, recipe: Recipe, number: int | None, patch: Patch | None) -> Result:
    """Return a result, or the part of it that is a patch, in the patch's orientation.

    For a variance map, the last image becomes the variance.
    """
    if number is not None:
        result = map_images(result, itemgetter(number))
    if recipe.noise:
        assert result.final is not None
        result = replace(result, final=variance_at(recipe.noise, result.final, patch))
    return map_images(result, patch.orient) if patch else result


def map_images(result: Result, change: Callable[[Array], Array]) -> Result:
    """Return a result with a function applied to each image."""
    return Result(
        None if result.final is None else change(result.final),
        None if result.encoded is None else change(result.encoded),
        {name: change(image) for name, image in result.kept.items()},
        result.estimates,
    )


def display_samples(result: Result, format_: Format) -> Array:
    """Return the last image in the type of a display format: uint8, uint16 or float32."""
    if format_.bits == 8:
        assert result.encoded is not None
        return result.encoded
    assert result.final is not None
    return result.final if format_.floats else to_16_bit(result.final)


def to_npy_type(image: Floats, kind: Kind, white_level: float | None = None) -> Array:
    """Return an image in the data type of its ``.npy`` file.

    DN are uint16, or uint32 if the white level is above 65535. Display values are float16. All
    other values are float32.

    >>> to_npy_type(np.array([[511.0, 7e4]]), Kind.RAW)
    array([[  511, 65535]], dtype=uint16)
    """
    if kind is Kind.RAW:
        dtype = np.uint16 if white_level is None or white_level <= 65535 else np.uint32
        return np.clip(np.rint(image), 0, np.iinfo(dtype).max).astype(dtype)
    return image.astype(np.float16 if kind is Kind.DISPLAY else np.float32, copy=False)
