"""Converts annotations of renders to annotations of their pictures.

The stages that move pixels (distortion, resizing, patches) warp annotations as well. Sidecars
contain their settings.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ClpipeError, ImageError, RequestError
from clpipe.chain.chain import Chain
from clpipe.chain.formats import extension_of
from clpipe.chain.overscan import with_overscan
from clpipe.chain.rendition import NOISY, Rendition
from clpipe.chain.request import Request
from clpipe.images.claims import display_size
from clpipe.images.tags import FLIPS
from clpipe.inputs.annotations import Annotations
from clpipe.inputs.poses import ViewIndex, stem_of
from clpipe.inputs.render_cameras import View
from clpipe.outputs.annotation_files import annotation_writer
from clpipe.outputs.annotation_warp import PixelMapping
from clpipe.outputs.output_pictures import picture_of
from clpipe.outputs.plan import file_suffix
from clpipe.outputs.sidecar import SidecarError, sidecar_files, values_at
from clpipe.reference.geometry import Composition, Crop, Margins, Orientation

LENGTH_KEYS = ("focal_length", "sensor_width")  # an image's metadata may contain these


def write_annotations(folder: Path, annotations: Annotations) -> list[str]:
    """Write the annotations of all noisy pictures of a folder, in the format of the input.

    Args:
        folder: the output directory of a run, or the folder of one member of its series.
        annotations: the annotations of the renders.

    Returns:
        Lines to print: the files that were written, and warnings.

    Raises:
        ImageError: a file cannot be written.
    """
    views = ViewIndex([View(each.name, {"render": each}) for each in annotations.renders])
    writer = annotation_writer(annotations)
    lines: list[str] = []
    sidecars = list(_sidecars(folder))
    name_counts = Counter(
        PurePosixPath(name).name
        for name in {stem_of(str(values["input"])) for _, values in sidecars}
    )
    unnamed = pictures = found = 0
    for path, values in sidecars:
        try:
            view = views.find(stem_of(str(values["input"])), name_counts)
        except RequestError:
            unnamed += 1
            continue
        render = view.values["render"]
        try:
            size = render.size or display_size(Path(str(values["input"])))
            for file, mapping in _pictures(path, values, size):
                found += writer.add(file.relative_to(folder).as_posix(), mapping, render)
                pictures += 1
        except (ClpipeError, KeyError, TypeError, ValueError) as error:
            lines.append(f"warning: {path}: its annotations are not written: {error}")
    if unnamed:
        pictures_are = "1 picture is" if unnamed == 1 else f"{unnamed} pictures are"
        lines.append(
            f"warning: {pictures_are} not annotated, because {annotations.file} does not list the "
            "render"
        )
    written = ", ".join(map(str, writer.write(folder)))
    return [f"wrote {written}: {found} annotations of {pictures} pictures", *lines]


def _sidecars(folder: Path) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Yield the sidecars of noisy pictures with their values, sorted."""
    for path in sorted(sidecar_files(folder)):
        try:
            values = values_at(path)
            if values and Rendition.from_record(values).role == NOISY:
                yield path, values
        except (SidecarError, KeyError, TypeError, ValueError):
            continue  # the run reported this sidecar


def _pictures(
    path: Path, values: Mapping[str, Any], render_size: tuple[int, int]
) -> Iterator[tuple[Path, PixelMapping]]:
    """Yield the picture files of a sidecar, each with the mapping from its render.

    Args:
        path: the sidecar.
        values: its values.
        render_size: width and height of the render in px.

    Raises:
        ImageError: the render has another size than its annotations state.
        KeyError, TypeError, ValueError: the values are damaged.
        ClpipeError: the chain cannot be made from the sidecar.
    """
    chain = chain_of(values)
    if "panorama" in values:
        raise ImageError("annotations of panoramas cannot be warped by a wide lens")
    parts = chain.geometry.parts if chain.geometry else ()
    width, height = render_size
    size = chain.size(*chain.margins.image_size(width, height))
    if size != (values["width"], values["height"]):
        raise ImageError(
            f"the annotations state a render of {width}x{height} pixels. Its picture would "
            f"have {size[0]}x{size[1]} pixels, but this picture has "
            f"{values['width']}x{values['height']}; give the annotations of this picture's "
            "render"
        )
    if "patches" not in values:
        file = picture_of(path, values)
        if file:
            yield (
                file,
                PixelMapping(
                    Composition(parts) if parts else None, *render_size, chain.margins, size
                ),
            )
        return
    side = values["request"].get("patch")
    ending, rendition = extension_of(values["request"]["formats"][0]), Rendition.from_record(values)
    stem = Path(values["name"]).name
    for number, patch in enumerate(values["patches"]):
        left, top = patch["place"]
        orientation = [Orientation(*FLIPS[patch["turn"]])] if patch["turn"] != 1 else []
        cut = (*parts, Crop(left, top, side, side), *orientation)
        file = path.with_name(stem + file_suffix(ending, rendition, number))
        yield file, PixelMapping(Composition(cut), *render_size, chain.margins, (side, side))


def chain_of(values: Mapping[str, Any]) -> Chain:
    """Return the chain of a picture, from the values of its sidecar.

    Raises:
        ClpipeError: the chain cannot be made.
        KeyError, TypeError, ValueError: the values are damaged.
    """
    request = Request.from_record(values["request"])
    settings = request.settings()
    known = settings.render.model_dump(exclude_none=True)
    stated = {name: values["output"].get(name) for name in LENGTH_KEYS if name not in known}
    stated = {name: value for name, value in stated.items() if value is not None}
    if stated:
        image = {**request.image, "render": {**request.image.get("render", {}), **stated}}
        request = request.for_image(request.image_name, image)
    chain = request.chain()
    overscan = values.get("overscan")
    return with_overscan(chain, Margins(**overscan)) if overscan else chain
