"""Series: each image with several cameras and ISOs, each in a folder of its own."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.camera.profile import load_camera
from clpipe.chain.isos import check_cameras
from clpipe.chain.settings import Settings, overlay
from clpipe.inputs.find import Job


@dataclass(frozen=True)
class Series:
    """Cameras and ISOs, each with each; fewer than two of either are no series of it.

    Args:
        cameras: names or profiles.
        isos: sensitivities.
        always: whether one camera or ISO that is named has a folder, too, so that others may come.
    """

    cameras: tuple[str, ...] = ()
    isos: tuple[float, ...] = ()
    always: bool = False

    @property
    def camera(self) -> str | None:
        """The camera of all images, where there is one, and no folder for it."""
        return self.cameras[0] if len(self.cameras) == 1 and not self.always else None

    @property
    def iso(self) -> float | None:
        """The ISO of all images, where there is one, and no folder for it."""
        return self.isos[0] if len(self.isos) == 1 and not self.always else None

    def under(self, output: Path) -> list[Path]:
        """The folders that its pictures go to, the output folder itself where there is no series.

        >>> Series(("sony-a7r2",), (100.0, 800.0)).under(Path("out"))
        [PosixPath('out/iso100'), PosixPath('out/iso800')]

        Raises:
            RequestError: two cameras have the same name.
        """
        return [output / folder for folder, _ in self._members()]

    def jobs(self, jobs: Sequence[Job], settings: Settings) -> list[Job]:
        """Each job once for each camera and ISO, one after the other.

        Args:
            jobs: the images.
            settings: of all of them.

        Raises:
            RequestError: a camera does not exist, is there twice or has not an ISO, or a row of a
                manifest says what a series is of.
        """
        members = list(self._members())
        if members == [("", {})]:
            return list(jobs)
        for _, values in members:
            check_cameras(overlay(settings, values))
        for job in jobs:
            for key in members[0][1]:
                if key in job.values:
                    raise RequestError(
                        f"{job.label}: it says its {key}, and --{key} has several; leave one out"
                    )
        return [
            replace(
                job,
                name=f"{folder}/{job.stem}",
                values={**job.values, **values} if job.values else values,  # shared
            )
            for job in jobs
            for folder, values in members
        ]

    def _members(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Folders, and the settings of what is in them."""
        cameras: list[tuple[str, dict[str, Any]]] = [("", {})]
        several = 0 if self.always else 1
        if len(self.cameras) > several:
            names = [load_camera(camera).name for camera in self.cameras]
            for name in names:
                if names.count(name) > 1:
                    raise RequestError(f"--camera: found {name} twice; give it once")
            cameras = [
                (f"{name}/", {"camera": camera})
                for name, camera in zip(names, self.cameras, strict=True)
            ]
        named = self.isos if len(self.isos) > several else ()
        isos = [(f"iso{iso:g}", {"iso": iso}) for iso in named]
        for folder, camera in cameras:
            for name, iso in isos or [("", {})]:
                yield (folder + name).rstrip("/"), {**camera, **iso}


def parse_isos(text: str) -> tuple[float, ...]:
    """Sensitivities with commas between.

    >>> parse_isos("100, 3200")
    (100.0, 3200.0)

    Raises:
        RequestError: one is no number above 0, or is there twice.
    """
    try:
        isos = [float(part) for part in text.split(",")]
    except ValueError:
        isos = [math.nan]
    return check_isos(isos, text)


def check_isos(isos: Sequence[float], text: str = "") -> tuple[float, ...]:
    """Sensitivities, as they are; ``text`` is what the user wrote.

    Raises:
        RequestError: one is no number above 0, or is there twice.
    """
    found = repr(text) if text else ", ".join(f"{iso:g}" for iso in isos)
    if not all(math.isfinite(iso) and iso > 0 for iso in isos):
        raise RequestError(f"--iso: found {found}; expected numbers above 0, such as 100,800,3200")
    names = [f"{iso:g}" for iso in isos]
    for name in names:
        if names.count(name) > 1:
            raise RequestError(f"--iso: found {found}, with {name} twice; give it once")
    return tuple(map(float, isos))
