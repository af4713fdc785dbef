"""Reads the contents of a dataset's folder from its sidecars: files and metadata by view."""

import logging
import os
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from clpipe.chain.rendition import NOISY, Rendition
from clpipe.outputs.carried import carried_files
from clpipe.outputs.sidecar import SidecarError, output_entries, sidecar_files, values_at

PICTURE = "picture"
# The folder of a series: CAMERA/isoNUMBER or isoNUMBER.
SERIES = re.compile(r"(?:[^/]+/)?iso[0-9.e+]+(?=/)|")
SPLITS = {3: "val", 7: "test"}  # the split of a view, by its number modulo 8

# The exceptions that values of a forged sidecar may raise.
DAMAGED = (KeyError, TypeError, ValueError, AttributeError, OverflowError)

log = logging.getLogger(__name__)


class PictureMetadata(NamedTuple):
    """The metadata of a picture as texts; ``variance_text`` is the variance of the raw's noise."""

    camera: str
    iso: str
    size: str
    variance_text: str
    ev: str
    gain: str
    exposure_time: str
    f_number: str
    lens: str


@dataclass(frozen=True)
class Member:
    """The files of one view with one camera and ISO.

    Args:
        view: the name of its render, without extension.
        folder: the folder for its camera and ISO; "" is the dataset's own.
        files: paths in the dataset's folder: "picture", ground truth such as "truth_clean",
            "carried", and the PNG of each layer by its name.
        metadata: the metadata of the picture.
        render: the path of its render, relative to the dataset's folder.
        layers: the records of carried layers in the sidecar.
    """

    view: str
    folder: str
    files: Mapping[str, str]
    metadata: PictureMetadata
    render: str
    layers: tuple[Mapping[str, Any], ...]

    @property
    def name(self) -> str:
        """The name in its sidecars."""
        return f"{self.folder}/{self.view}".lstrip("/")


def split_of(number: int) -> str:
    """Return the split of a view: of every eight, one is for validation and one for tests.

    >>> [split_of(number) for number in range(9)].count("train"), split_of(3), split_of(15)
    (7, 'val', 'test')
    """
    return SPLITS.get(number % 8, "train")


def splits_of(members: list[Member]) -> dict[str, str]:
    """Return the split of each view, by name, sorted. All pictures of a view have one split."""
    views = dict.fromkeys(member.view for member in members)
    return {view: split_of(number) for number, view in enumerate(sorted(views))}


def members_of(folder: Path, renders: str) -> list[Member]:
    """Return the members of a dataset, sorted by view, then by camera and ISO.

    Args:
        folder: the folder of the dataset.
        renders: the name of the folder in it that contains renders.
    """
    found: dict[str, dict[str, tuple[Path, Mapping[str, Any]]]] = defaultdict(dict)
    for path in sidecar_files(folder):
        if path.parts[len(folder.parts)] == renders:
            continue
        try:
            if values := values_at(path):
                found[str(values["name"])][str(values["picture"])] = path, values
        except (SidecarError, *DAMAGED):
            log.warning("%s; the card omits this file", SidecarError(path))
    members = []
    for name, renditions in found.items():
        try:
            if member := _member(folder, renders, name, renditions):
                members.append(member)
        except DAMAGED:
            path = next(path for path, _ in renditions.values())
            log.warning("%s; the card omits this file", SidecarError(path))
    return sorted(members, key=lambda each: (each.view, each.folder))


def _member(
    folder: Path, renders: str, name: str, renditions: Mapping[str, tuple[Path, Mapping[str, Any]]]
) -> Member | None:
    """Return the member of a view, or None if its picture is missing; see :func:`members_of`.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, OverflowError: the values are damaged.
    """
    files: dict[str, str] = {}
    noisy: Mapping[str, Any] | None = None
    for suffix, (path, values) in sorted(renditions.items()):
        first, *_ = output_entries(values)
        directory = path.parent.relative_to(folder)
        if not (path.parent / first).exists():
            continue
        if Rendition.from_record(values).role == NOISY and noisy is None:
            noisy = values
        files[suffix.removeprefix(".") or PICTURE] = (directory / first).as_posix()
        files |= {k: (directory / file).as_posix() for k, file in carried_files(values).items()}
    if noisy is None:
        return None
    series_match = SERIES.match(name)
    series = series_match[0] if series_match else ""
    view = name.removeprefix(series).lstrip("/")
    input_path = Path(str(noisy["input"]))
    render = os.path.relpath(input_path.absolute(), folder.absolute())
    if (folder / renders / input_path.name).exists():  # even if the dataset was moved
        render = f"{renders}/{input_path.name}"
    return Member(view, series, files, _metadata(noisy), render, tuple(noisy.get("carried", ())))


def _metadata(values: Mapping[str, Any]) -> PictureMetadata:
    """Return the metadata of a picture for the card, from the values of its sidecar.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, OverflowError: the values are damaged.
    """
    noise = (values["noise"] or {}).get("signal", {"a": 0.0, "b": 0.0})
    size = f"{values['width']:d}x{values['height']:d}"
    variance_text = f"{noise['a']:.3g} y + {noise['b']:.3g}"
    light = values["photometry"] or {}
    names = ("ev", "gain", "exposure_time", "f_number")
    exposed = {n: "" if light.get(n) is None else f"{light[n]:g}" for n in names}
    camera, iso = str(values["camera"]), f"{values['iso']:g}"
    return PictureMetadata(camera, iso, size, variance_text, **exposed, lens=_lens(values))


def _lens(values: Mapping[str, Any]) -> str:
    """Return the focal lengths and distortion of a picture as text."""
    camera = values["intrinsics"]
    if not camera:
        return "not known"
    length = (values.get("output") or {}).get("focal_length")
    nonzero = {k: v for k, v in camera["distortion"].items() if v}
    length_text = f"{length:g} mm, " if length else ""
    terms = ", ".join(f"{name} {value:.4g}" for name, value in nonzero.items())
    return (
        f"{length_text}fx {camera['fx']:.1f} px, {camera['model']}{f' ({terms})' if terms else ''}"
    )
