"""Panoramas: groups the files of a cube or camera rig, reads them, and builds one atlas image."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from clpipe.base.errors import ImageError, RequestError
from clpipe.base.reading import check_unchanged
from clpipe.base.types import Array
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import Settings
from clpipe.images.read import SourceImage
from clpipe.inputs.companions import SEPARATORS
from clpipe.inputs.jobs import Job
from clpipe.inputs.poses import stem_of
from clpipe.inputs.render_cameras import read_views
from clpipe.inputs.subframes import check_values, with_file_records
from clpipe.reference.panorama import (
    CUBE,
    OPENEXR_CUBE,
    LatitudeLongitude,
    Panorama,
    Rotation,
    View,
    Views,
)
from clpipe.stage import StageRole
from clpipe.stages.projection import WideAngle

FACES = 6
RIGHT_ANGLE = 90.0
# Relative to the largest coordinate; cameras this close count as at one place.
POSITION_TOLERANCE = 1e-6

CUBE_MAP, LATITUDE_LONGITUDE = "CubeFace Environment", "LatLong Environment"


@dataclass(frozen=True)
class Rig:
    """The cameras of views from one point. Each file's name ends in the name of its view.

    Args:
        views: for each view, its rotation, and fx, fy, cx and cy in px, or None for a cube's face.
        angle: the field of view of a cube's face, in degrees.
        source: the file that defines the rig, for messages.
    """

    views: dict[str, tuple[Rotation, tuple[float, float, float, float] | None]]
    angle: float = RIGHT_ANGLE
    source: str = ""

    def view(self, name: str, width: int, height: int) -> View:
        """Return the view called ``name`` of a file with this width and height in px."""
        rotation, camera = self.views[name]
        if camera is None:
            return View.from_angle(rotation, width, height, self.angle)
        return View(rotation, *camera, width, height)

    def split_name(self, path: Path) -> tuple[str, str] | None:
        """Split a file's stem into the panorama's name and the view's name, or return None.

        >>> Rig({"front": ()}).split_name(Path("a/view00_front.exr"))
        ('view00', 'front')
        """
        for name in self.views:
            prefix = path.stem[: -len(name)]
            if path.stem.endswith(name) and len(prefix) > 1 and prefix[-1] in SEPARATORS:
                return prefix[:-1], name
        return None


def wide_lens_of(settings: Settings) -> WideAngle | None:
    """Return the wide lens of a chain, which projects panoramas, or None."""
    name = stage_in(StageRole.VIEW).name
    if name not in settings.step_names:
        return None
    method = settings.method(name)
    return method if isinstance(method, WideAngle) else None


def rig_for(wide: WideAngle) -> Rig:
    """Return the rig of a wide lens: the one in its file ``views``, or a cube.

    Raises:
        RequestError: the file cannot be read, lacks a camera's values, or its cameras are not at
            one point.
    """
    if wide.views is None:
        return Rig(
            {name: (rotation, None) for name, rotation in CUBE.items()},
            wide.face_angle or RIGHT_ANGLE,
        )
    path, parameter = Path(wide.views), f"{stage_in(StageRole.VIEW).name}.views"
    try:
        read = read_views(path)
    except RequestError as error:
        raise RequestError(str(error).replace("--poses", parameter, 1)) from None
    views: dict[str, tuple[Rotation, tuple[float, float, float, float] | None]] = {}
    points = []
    for each in read:
        values = each.values
        camera = tuple(float(values.get(key, 0)) for key in ("fx", "fy", "cx", "cy"))
        if each.problem or not all(camera[:2]) or "rotation" not in values:
            problem = each.problem or "fx, fy, cx, cy or its pose is missing; add them to the file"
            raise RequestError(f"{parameter} {path}: view {each.name}: {problem}")
        camera_rotation = np.array(values["rotation"], float)
        points.append(-camera_rotation.T @ np.array(values["translation"], float))
        rotation = tuple(tuple(map(float, row)) for row in camera_rotation.T)
        views[PurePosixPath(stem_of(each.name)).name] = rotation, camera  # type: ignore[assignment]
    distance = np.ptp(points, 0).max()
    if distance > POSITION_TOLERANCE * max(abs(np.array(points)).max(), 1):
        raise RequestError(
            f"{parameter} {path}: its cameras are up to {distance:g} apart, but the views of a "
            "panorama are taken from one point; render them all from the same position"
        )
    return Rig(views, source=str(path))


def group_panoramas(jobs: Sequence[Job], wide: WideAngle | None) -> list[Job]:
    """Return the jobs, with the files of one panorama joined into one job.

    That job has the files' name without the name of the view. A file that is not a view stays a
    separate job.

    Raises:
        RequestError: the files are sub-frames, or their values differ.
    """
    if wide is None:
        return list(jobs)
    rig = rig_for(wide)
    groups: dict[object, list[tuple[str, Job]]] = {}
    for job in jobs:
        found = None if job.is_panorama else rig.split_name(job.path)
        group_key = id(job) if found is None else (job.path.parent, found[0], job.path.suffix)
        groups.setdefault(group_key, []).append((found[1] if found else "", job))
    result = []
    order = list(rig.views)
    for group in groups.values():
        name, first = group[0]
        if not name:
            result.append(first)
            continue
        (name, first), *others = sorted(group, key=lambda each: order.index(each[0]))
        check_values([first, *(job for _, job in others)], "seen from the same point")
        if any(job.subframes for _, job in group):
            raise RequestError(
                f"{first.path}: a view of a panorama cannot also be a sub-frame; set "
                f"{stage_in(StageRole.SHUTTER).name}.subframes=1"
            )
        key = PurePosixPath(first.key)
        stem = key.stem[: -len(name) - 1]
        result.append(
            replace(
                first,
                key=str(key.with_name(f"{stem}{key.suffix}")),
                subframes=tuple(job.path for _, job in others),
                is_panorama=True,
            )
        )
    return result


def read_panorama(job: Job, read: Callable[[Path], SourceImage], wide: WideAngle) -> SourceImage:
    """Return the image of a job for a wide lens: an atlas of all views, with its panorama.

    A render that is not a panorama, according to its header and name, is returned unchanged.

    Raises:
        ImageError: a file cannot be read, or its size differs from the first file's.
    """
    sources: list[SourceImage] = []
    for path in job.paths:
        with check_unchanged(path):
            sources.append(read(path))
    first = sources[0]
    for path, other in zip(job.paths, sources, strict=True):
        if other.wavelengths != first.wavelengths:
            raise ImageError(
                f"{path}: the spectral bands of this view are not those of {job.path}, from the "
                "same point; render all views with the same bands"
            )
        if other.pixels.ndim != 3 or other.pixels.shape != first.pixels.shape:
            size = "is a mosaic" if other.pixels.ndim != 3 else f"has {_size(other.pixels)} pixels"
            raise ImageError(
                f"{path}: this view {size}, but {job.path}, from the same point, has "
                f"{_size(first.pixels)}; render all views in colour at one size"
            )
    panorama = panorama_of(job.paths, wide, first.envmap, *first.pixels.shape[1::-1])
    if panorama is None:
        return first
    images = [piece for each in sources for piece in pieces(panorama, each.pixels)]
    atlas = panorama.atlas(images, wide.filter)
    return with_file_records(replace(first, pixels=atlas, panorama=panorama), job, sources)


def check_subframes(job: Job, source: SourceImage, wide: WideAngle, is_rolling: bool) -> None:
    """Check that a wide lens can view the mean of an exposure's sub-frames.

    Args:
        job: the job.
        source: the mean.
        wide: the lens.
        is_rolling: whether rows are exposed one after the other.

    Raises:
        ImageError: the sub-frames are views of a panorama, or the shutter is rolling.
    """
    shutter = stage_in(StageRole.SHUTTER).name
    if panorama_of((job.path,), wide, source.envmap, *source.pixels.shape[1::-1]):
        raise ImageError(
            f"{job.path}: a view of a panorama cannot also be a sub-frame; set "
            f"{shutter}.subframes=1"
        )
    if is_rolling:
        raise ImageError(
            f"{job.path}: a rolling shutter exposes the rows of a picture, but a wide lens mixes "
            f"the rows of the sub-frames; set {shutter}.line_time=0"
        )


def panorama_of(
    paths: Sequence[Path], wide: WideAngle, envmap: str, width: int, height: int
) -> Panorama | None:
    """Return the panorama that files form, or None for a single view, which any render can be.

    Args:
        paths: the files.
        wide: the lens that views them.
        envmap: OpenEXR's attribute of the first file, "" if it has none.
        width: the width of each file in px.
        height: its height in px.

    Raises:
        ImageError: a cube map is not six squares.
    """
    if wide.source == "map" or (envmap == LATITUDE_LONGITUDE and len(paths) == 1):
        return LatitudeLongitude(width, height, on_edges=envmap == LATITUDE_LONGITUDE)
    if envmap == CUBE_MAP:
        if height != FACES * width or width < 2:
            raise ImageError(
                f"{paths[0]}: this cube map has {width}x{height} pixels, but its height must be "
                f"{FACES} times its width, for six faces stacked vertically"
            )
        intrinsics = (width - 1) / 2, (width - 1) / 2, width / 2, width / 2
        return Views(tuple(View(rotation, *intrinsics, width, width) for rotation in OPENEXR_CUBE))
    rig = rig_for(wide)
    names = [rig.split_name(path) for path in paths]
    if not all(names):
        return None
    return Views(tuple(rig.view(name[1], width, height) for name in names if name))


def pieces(panorama: Panorama, image: Array) -> Iterator[Array]:
    """Yield the views in a file's image: the image itself, or the six faces of a cube map."""
    is_cube = isinstance(panorama, Views) and len(image) == FACES * panorama.views[0].height
    yield from np.split(image, FACES) if is_cube else [image]


def _size(pixels: Array) -> str:
    return f"{pixels.shape[1]}x{pixels.shape[0]}"
