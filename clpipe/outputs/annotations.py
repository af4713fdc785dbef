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
from clpipe.inputs.poses import Views, stem_of
from clpipe.inputs.render_cameras import View
from clpipe.outputs.annotated import Way
from clpipe.outputs.annotation_files import files_for
from clpipe.outputs.photographs import picture_of
from clpipe.outputs.plan import ending_behind
from clpipe.outputs.sidecar import SidecarError, sidecar_files, values_at
from clpipe.reference.geometry import (
    Composition,
    Crop,
    Margins,
    Orientation,
)

LENGTHS = ("focal_length", "sensor_width")  # values that an image may state itself


def write_annotations(folder: Path, annotations: Annotations) -> list[str]:
    """Write the annotations of all noisy pictures of a folder, in the format of the renders' own.

    Args:
        folder: the output directory of a run, or the folder of one member of its series.
        annotations: the annotations of the renders.

    Returns:
        Lines to print: the files that were written, and warnings.

    Raises:
        ImageError: a file cannot be written.
    """
    views = Views([View(each.name, {"render": each}) for each in annotations.renders])
    files = files_for(annotations)
    lines: list[str] = []
    sidecars = list(_sidecars(folder))
    called = Counter(
        PurePosixPath(name).name
        for name in {stem_of(str(values["input"])) for _, values in sidecars}
    )
    unnamed = pictures = found = 0
    for path, values in sidecars:
        try:
            view = views.find(stem_of(str(values["input"])), called)
        except RequestError:
            unnamed += 1
            continue
        render = view.values["render"]
        try:
            size = render.size or display_size(Path(str(values["input"])))
            for file, way in _pictures(path, values, size):
                found += files.add(file.relative_to(folder).as_posix(), way, render)
                pictures += 1
        except (ClpipeError, KeyError, TypeError, ValueError) as error:
            lines.append(f"warning: {path}: its annotations are not written: {error}")
    if unnamed:
        pictures_are = "1 picture is" if unnamed == 1 else f"{unnamed} pictures are"
        lines.append(
            f"warning: {pictures_are} not annotated, because {annotations.file} does not list the "
            "render"
        )
    written = ", ".join(map(str, files.write(folder)))
    return [f"wrote {written}: {found} annotations of {pictures} pictures", *lines]


def _sidecars(folder: Path) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """Yield the sidecars of noisy pictures with their values, sorted."""
    for path in sorted(sidecar_files(folder)):
        try:
            values = values_at(path)
            if values and Rendition.from_record(values).role == NOISY:
                yield path, values
        except (SidecarError, KeyError, TypeError, ValueError):
            continue  # the run has reported it


def _pictures(
    path: Path, values: Mapping[str, Any], own: tuple[int, int]
) -> Iterator[tuple[Path, Way]]:
    """Yield the picture files of a sidecar, each with the mapping from its render.

    Args:
        path: the sidecar.
        values: its values.
        own: width and height of the render in px.

    Raises:
        ImageError: the render has another size than its annotations state.
        KeyError, TypeError, ValueError: the values are damaged.
        ClpipeError: the chain cannot be made from the sidecar.
    """
    chain = chain_of(values)
    if "panorama" in values:
        raise ImageError("annotations of panoramas cannot be warped by a wide lens")
    parts = chain.geometry.parts if chain.geometry else ()
    size = chain.size(*chain.margins.image_size(*own))
    if size != (values["width"], values["height"]):
        raise ImageError(
            f"the annotations are for a render of {own[0]}x{own[1]} pixels, whose picture would "
            f"have {size[0]}x{size[1]}, but the picture has {values['width']}x{values['height']}"
        )
    if "patches" not in values:
        file = picture_of(path, values)
        if file:
            yield file, Way(Composition(parts) if parts else None, *own, chain.margins, size)
        return
    side = values["request"]["patch"]
    ending, rendition = extension_of(values["request"]["formats"][0]), Rendition.from_record(values)
    stem = Path(values["name"]).name
    for number, patch in enumerate(values["patches"]):
        left, top = patch["place"]
        turned = [Orientation(*FLIPS[patch["turn"]])] if patch["turn"] != 1 else []
        cut = (*parts, Crop(left, top, side, side), *turned)
        file = path.with_name(stem + ending_behind(ending, rendition, number))
        yield file, Way(Composition(cut), *own, chain.margins, (side, side))


def chain_of(values: Mapping[str, Any]) -> Chain:
    """Return the chain of a picture, from the values of its sidecar.

    Raises:
        ClpipeError: the chain cannot be made.
        KeyError, TypeError, ValueError: the values are damaged.
    """
    request = Request.from_record(values["request"])
    settings = request.settings()
    known = settings.render.model_dump(exclude_none=True)
    said = {name: values["output"].get(name) for name in LENGTHS if name not in known}
    said = {name: value for name, value in said.items() if value is not None}
    if said:
        image = {**request.image, "render": {**request.image.get("render", {}), **said}}
        request = request.for_image(request.image_name, image)
    chain = request.chain()
    overscan = values.get("overscan")
    return with_overscan(chain, Margins(**overscan)) if overscan else chain
