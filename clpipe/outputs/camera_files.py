"""Writes the cameras of an output directory: cameras.json, COLMAP's text model and nerfstudio's
transforms.json.

The cameras come from sidecars. Pictures are sorted by name, so the bytes depend on nothing else.
"""

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from clpipe.base.errors import ImageError
from clpipe.base.files import create_parents, sync_folder, write_atomic
from clpipe.base.reading import read_bytes
from clpipe.outputs.existing import is_marked
from clpipe.outputs.photographs import MODELS, Photograph, photographs
from clpipe.outputs.sidecar import is_sidecar
from clpipe.outputs.views import CAMERAS, COLMAP, TRANSFORMS, cameras_json, colmap, nerfstudio

FILES = tuple(
    model + name
    for model in MODELS.values()
    for name in (
        *(CAMERAS, TRANSFORMS),
        *(f"{COLMAP}/cameras.txt", f"{COLMAP}/images.txt", f"{COLMAP}/points3D.txt"),
    )
)


@dataclass(frozen=True)
class Written:
    """The camera files that were written for a folder.

    Args:
        files: their paths in the folder; empty if no picture has known intrinsics.
        pictures: the number of pictures in them.
        left_out: sentences about pictures that are missing in some files, and why.
    """

    files: tuple[str, ...]
    pictures: int
    left_out: tuple[str, ...]

    def lines(self, folder: Path) -> list[str]:
        """Return lines to print about files written to ``folder``."""
        warnings = [f"warning: {each}" for each in self.left_out]
        if not self.files:
            return warnings
        shown = dict.fromkeys("/".join(name.split("/")[:2]) for name in self.files)
        files = ", ".join(str(folder / name) for name in shown)
        return [f"wrote {files}: {self.pictures} picture{'s' * (self.pictures != 1)}", *warnings]


def check_camera_files(folder: Path) -> None:
    """Check that the camera files of a folder may be written.

    Raises:
        ImageError: a file of the same name exists that clpipe did not write.
    """
    for path in (folder / name for name in FILES):
        if os.path.lexists(path) and not (is_marked(path) or _is_taken(path)):
            raise ImageError(
                f"{path}: clpipe did not write this file, and would overwrite it with the cameras "
                "of this folder's pictures; move it, or choose another output directory"
            )


def write_camera_files(folder: Path, splits: Mapping[str, str] = MappingProxyType({})) -> Written:
    """Write the cameras of an output directory, from its sidecars.

    Args:
        folder: the output directory, or a folder in it.
        splits: "train", "val" or "test" for each picture, by its name in sidecars.

    Raises:
        ImageError: a file cannot be written, or was not written by clpipe.
    """
    check_camera_files(folder)
    left_out: dict[str, list[str]] = defaultdict(list)
    found = sorted(photographs(folder, left_out), key=lambda each: each.file)
    texts: dict[str, str] = {}
    for role, model in MODELS.items():
        own = [each for each in found if each.role == role]
        texts |= {
            model + name: text for name, text in texts_of(own, model, left_out, splits).items()
        }
    taken = [name for name in FILES if _is_taken(folder / name)]
    for name in (name for name in FILES if name not in taken):
        path = folder / name
        if name in texts:
            create_parents(path)
            write_atomic(path, texts[name].encode())
            sync_folder(path.parent)
        elif texts:
            path.unlink(missing_ok=True)  # its pictures have been removed
    reasons = tuple(
        f"{len(files)} picture{'s' * (len(files) > 1)} {why}, such as {min(files)}"
        for why, files in left_out.items()
        if files
    )
    reasons += tuple(
        f"{folder / name} is the sidecar of a picture, so the cameras are not written to it; give "
        "that image another name"
        for name in taken
        if name in texts
    )
    written = tuple(name for name in FILES if name in texts and name not in taken)
    return Written(written, len(found), reasons)


def texts_of(
    pictures: Sequence[Photograph],
    model: str,
    left_out: Mapping[str, list[str]],
    splits: Mapping[str, str],
) -> dict[str, str]:
    """Return the texts of the camera files for pictures of one kind, by file name.

    Args:
        pictures: the pictures, sorted.
        model: the folder of these files, relative to the output directory.
        left_out: receives the names of pictures that are missing in some files, by reason.
        splits: see :func:`write_camera_files`.
    """
    if not pictures:
        return {}
    up = "../" * model.count("/")
    posed = [each for each in pictures if each.pose]
    if posed:
        left_out[f"without a pose, so not in {TRANSFORMS} and images.txt"] += [
            each.file for each in pictures if not each.pose
        ]
    texts = {CAMERAS: cameras_json(pictures, up), **colmap(pictures, posed, left_out)}
    if nerf := nerfstudio(posed, up, left_out, splits):
        texts[TRANSFORMS] = nerf
    return texts


def _is_taken(path: Path) -> bool:
    """Return whether a camera file would overwrite the sidecar of a picture."""
    try:
        return is_sidecar(read_bytes(path))
    except OSError:
        return False
