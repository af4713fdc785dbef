"""Series: every image with several cameras and ISOs, and a folder for each combination."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.text import as_texts
from clpipe.camera.profile import load_camera
from clpipe.chain.drawing import with_iso_range
from clpipe.chain.isos import check_cameras
from clpipe.chain.settings import Settings, overlay
from clpipe.inputs.jobs import Job


@dataclass(frozen=True)
class Series:
    """All combinations of some cameras and ISOs.

    Cameras or ISOs get folders only if there are several, unless ``always`` is set.

    Args:
        cameras: names or profiles.
        isos: ISO values.
        always: whether a single camera or ISO gets a folder as well, so that others can be added.
    """

    cameras: tuple[str, ...] = ()
    isos: tuple[float, ...] = ()
    always: bool = False

    @property
    def common(self) -> dict[str, Any]:
        """The settings that all images share: a single camera or ISO without a folder."""
        lists = {"camera": self.cameras, "iso": self.isos}
        return {k: v[0] for k, v in lists.items() if len(v) == 1 and not self.always}

    def folders_in(self, output: Path) -> list[Path]:
        """Return the folders of its pictures, or the output directory if there is no series.

        >>> Series(("sony-a7r2",), (100.0, 800.0)).folders_in(Path("out"))
        [PosixPath('out/iso100'), PosixPath('out/iso800')]

        Raises:
            RequestError: two cameras have the same name.
        """
        return [output / folder for folder, _ in self.members()]

    def jobs(self, jobs: Sequence[Job], settings: Settings) -> list[Job]:
        """Return each job once for each combination of camera and ISO.

        Args:
            jobs: the images.
            settings: the settings of all images.

        Raises:
            RequestError: a camera does not exist, is listed twice or lacks an ISO, or a row of a
                manifest sets the camera or ISO as well.
        """
        members = list(self.members())
        if members == [("", {})]:
            return list(jobs)
        for _, values in members:
            check_cameras(overlay(settings, values))
        for job in jobs:
            for key in members[0][1]:
                if key in job.values:
                    raise RequestError(
                        f"{job.label}: this row sets {key}, but --{key} lists several; remove one "
                        "of them"
                    )
        return [
            replace(
                job,
                name=f"{folder}/{job.stem}",
                # Jobs share the values if they have none of their own.
                values={**job.values, **values} if job.values else values,
            )
            for job in jobs
            for folder, values in members
        ]

    def members(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the folders, each with the settings of its pictures."""
        cameras: list[tuple[str, dict[str, Any]]] = [("", {})]
        threshold = 0 if self.always else 1
        if len(self.cameras) > threshold:
            names = [load_camera(camera).name for camera in self.cameras]
            for name in names:
                if names.count(name) > 1:
                    raise RequestError(f"--camera: {name} is listed twice; list it once")
            cameras = [
                (f"{name}/", {"camera": camera})
                for name, camera in zip(names, self.cameras, strict=True)
            ]
        named = self.isos if len(self.isos) > threshold else ()
        isos = [(f"iso{iso:g}", {"iso": iso}) for iso in named]
        for folder, camera in cameras:
            for name, iso in isos or [("", {})]:
                yield (folder + name).rstrip("/"), {**camera, **iso}


def split_series(
    settings: Mapping[str, Any], always: bool = False
) -> tuple[Series, dict[str, Any]]:
    """Split settings into a series of cameras and ISOs, and the settings that all images share.

    >>> split_series({"camera": ["a", "b"], "iso": 800, "seed": 1})[1]
    {'seed': 1, 'iso': 800.0}

    Args:
        settings: nested values. A camera is one name or several; an ISO is a number, several, or a
            text such as "100,800". Random draws of either stay in the settings.
        always: as for :class:`Series`.

    Raises:
        RequestError: an ISO is not a number above 0, or occurs twice.
    """
    settings = with_iso_range(settings)
    series_values = {
        key: settings[key]
        for key in ("camera", "iso")
        if key in settings and not isinstance(settings[key], Mapping)
    }
    isos = check_isos(series_values["iso"]) if "iso" in series_values else ()
    series = Series(as_texts(series_values.get("camera")), isos, always)
    others = {key: value for key, value in settings.items() if key not in series_values}
    return series, others | series.common


def check_isos(isos: float | str | Sequence[float]) -> tuple[float, ...]:
    """Return one ISO or several as a tuple. A text has commas between them.

    >>> check_isos("100, 3200"), check_isos(100)
    ((100.0, 3200.0), (100.0,))

    Raises:
        RequestError: one is not a number above 0, or occurs twice.
    """
    found, items = repr(isos), isos.split(",") if isinstance(isos, str) else isos
    try:
        numbers = tuple(map(float, [items] if isinstance(items, int | float) else items))
    except ValueError:
        numbers = (math.nan,)
    if not all(math.isfinite(iso) and iso > 0 for iso in numbers):
        raise RequestError(
            f"--iso: found {found}; expected numbers above 0 with commas between them, such as "
            "100,800,3200. To draw the ISO of each image, use a range such as 100..6400"
        )
    names = [f"{iso:g}" for iso in numbers]
    for name in names:
        if names.count(name) > 1:
            raise RequestError(f"--iso: found {found}, which lists {name} twice; list it once")
    return numbers
