"""Jobs: the images of a run, each with its files, its key and its own settings."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.base.urls import url_of
from clpipe.chain.rendition import Rendition


@dataclass(frozen=True)
class Place:
    """The place of a frame in a sequence; see :mod:`clpipe.inputs.sequences`.

    Args:
        key: the name of the sequence among the inputs. Its random draws depend on it.
        sequence: its path in the output directory, without extension.
        index: the place of the frame in temporal order, from 0. Missing frames are counted. It is
            no whole number between equal intervals.
        count: the number of places.
        interval: the time between two places in s; None is not known.
    """

    key: str
    sequence: str
    index: float
    count: int
    interval: float | None = None


@dataclass(frozen=True)
class Job:
    """One image to process.

    Args:
        path: the file.
        key: its name among the inputs. Random draws and the names of outputs depend on it.
        name: the path of its outputs in the output directory, without extension; "" uses the key.
        named_by_user: whether the user named the file by path, glob or manifest, not its folder.
        values: settings of this image only, nested like a configuration.
        frames: the number of frames; None uses the request's number.
        location: its manifest and row; "" if it is not in a manifest.
        renditions: the renditions to make; None is all.
        as_written: the path as the user wrote it, if ``path`` has been made absolute.
        subframes: further files of the same exposure.
        size: the width and height in px that the image must have; None allows any.
        problem: why it cannot be processed, if that is known before it is read.
        is_panorama: whether its files are views of a panorama and not sub-frames.
        place: its place in a sequence; None if it is a single image.
        first: the file of the first frame of its sequence.
        time: when it was taken, in s; None is not known.
    """

    path: Path
    key: str
    name: str = ""
    named_by_user: bool = True
    values: Mapping[str, Any] = field(default_factory=dict)
    frames: int | None = None
    location: str = ""
    renditions: tuple[Rendition, ...] | None = None
    as_written: str = ""
    subframes: tuple[Path, ...] = ()
    size: tuple[int, int] | None = None
    problem: str = ""
    is_panorama: bool = False
    place: Place | None = None
    first: Path | None = None
    time: Fraction | None = None

    def check(self) -> None:
        """Raise the known problem of this job, if there is one.

        Raises:
            ImageError: the job has a problem.
        """
        if self.problem:
            raise ImageError(f"{self.label}: {self.problem}")

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of its exposure, the first one first."""
        return (self.path, *self.subframes)

    def at(self, moment: str) -> Path:
        """Return the file at a moment of its exposure: "start", "middle" or "end".

        The middle of an even number of files is the last file of the first half.
        """
        places = {"start": 0, "middle": (len(self.paths) - 1) // 2, "end": -1}
        return self.paths[places[moment]]

    @property
    def display_name(self) -> str:
        """The name of the file in messages and logs: its URL, or else its path."""
        return url_of(self.path) or str(self.path)

    @property
    def input(self) -> str:
        """The path that is stored and printed: as the user wrote it, or else the display name."""
        return self.as_written or self.display_name

    @cached_property
    def stem(self) -> str:
        """The path of its outputs in the output directory, without extension."""
        return self.name or str(Path(self.key).with_suffix(""))

    @property
    def label(self) -> str:
        """The job's name in errors: its file, with its manifest and row."""
        return f"{self.display_name} ({self.location})" if self.location else self.display_name
