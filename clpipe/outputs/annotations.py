"""Annotations of renders as those of their pictures.

They go through what moves the pixels (distortion, resizing, patches), as the sidecars say it.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import ClpipeError, ImageError, RequestError
from clpipe.chain.chain import Chain
from clpipe.chain.formats import ending_of
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

LENGTHS = ("focal_length", "sensor_width")  # that an image may say of itself


def write_annotations(folder: Path, annotations: Annotations) -> list[str]:
    """Write the annotations of all noisy pictures of a folder, in the format that they have.

    Args:
        folder: of a run, or of one of its series.
        annotations: of the renders.

    Returns:
        Lines for people: what was written, and what could not be.

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
            lines.append(f"warning: {path}: its annotations are left out: {error}")
    if unnamed:
        lines.append(
            f"warning: {unnamed} pictures are of renders that {annotations.file} does not name"
        )
    written = ", ".join(map(str, files.write(folder)))
    return [f"wrote {written}: {found} annotations of {pictures} pictures", *lines]


def _sidecars(folder: Path) -> Iterator[tuple[Path, Mapping[str, Any]]]:
    """The sidecars of noisy pictures, sorted."""
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
    """The pictures of a sidecar: each file, and how a render's places come into it.

    Args:
        path: of the sidecar.
        values: its values.
        own: width and height of the render.

    Raises:
        ImageError: the render is of another size than the annotations say.
        KeyError, TypeError, ValueError: the values are damaged.
        ClpipeError: the chain cannot be made again.
    """
    chain = chain_of(values)
    if "panorama" in values:
        raise ImageError("annotations of what is seen all around do not go through a wide lens")
    parts = chain.geometry.parts if chain.geometry else ()
    size = chain.size(*chain.margins.around(*own))
    if size != (values["width"], values["height"]):
        raise ImageError(
            f"the annotations are of {own[0]}x{own[1]} pixels, of which a "
            f"picture of {size[0]}x{size[1]} would be made, but it has "
            f"{values['width']}x{values['height']}"
        )
    if "patches" not in values:
        file = picture_of(path, values)
        if file:
            yield file, Way(Composition(parts) if parts else None, *own, chain.margins, size)
        return
    side = values["request"]["patch"]
    ending, rendition = ending_of(values["request"]["formats"][0]), Rendition.from_record(values)
    stem = Path(values["name"]).name
    for number, patch in enumerate(values["patches"]):
        left, top = patch["place"]
        turned = [Orientation(*FLIPS[patch["turn"]])] if patch["turn"] != 1 else []
        cut = (*parts, Crop(left, top, side, side), *turned)
        file = path.with_name(stem + ending_behind(ending, rendition, number))
        yield file, Way(Composition(cut), *own, chain.margins, (side, side))


def chain_of(values: Mapping[str, Any]) -> Chain:
    """The chain of a picture, as its sidecar says it.

    Raises:
        ClpipeError: it cannot be made again.
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
