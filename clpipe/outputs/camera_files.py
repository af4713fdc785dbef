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
from clpipe.outputs.camera_formats import (
    CAMERAS,
    COLMAP,
    TRANSFORMS,
    cameras_json,
    colmap,
    nerfstudio,
)
from clpipe.outputs.existing import is_marked
from clpipe.outputs.output_pictures import MODEL_FOLDERS, OutputPicture, output_pictures
from clpipe.outputs.sidecar import is_sidecar

FILES = tuple(
    model + name
    for model in MODEL_FOLDERS.values()
    for name in (
        *(CAMERAS, TRANSFORMS),
        *(f"{COLMAP}/cameras.txt", f"{COLMAP}/images.txt", f"{COLMAP}/points3D.txt"),
    )
)


@dataclass(frozen=True)
class CameraFiles:
    """The camera files that were written for a folder.

    Args:
        files: their paths in the folder; empty if no picture has known intrinsics.
        pictures: the number of pictures in them.
        warnings: sentences about pictures that are missing in some files, and why.
    """

    files: tuple[str, ...]
    pictures: int
    warnings: tuple[str, ...]

    def lines(self, folder: Path) -> list[str]:
        """Return lines to print about files written to ``folder``."""
        notes = [f"warning: {each}" for each in self.warnings]
        if not self.files:
            return notes
        shown = dict.fromkeys("/".join(name.split("/")[:2]) for name in self.files)
        files = ", ".join(str(folder / name) for name in shown)
        return [f"wrote {files}: {self.pictures} picture{'s' * (self.pictures != 1)}", *notes]


def check_camera_files(folder: Path) -> None:
    """Check that the camera files of a folder may be written.

    Raises:
        ImageError: a file of the same name exists that clpipe did not write.
    """
    for path in (folder / name for name in FILES):
        if os.path.lexists(path) and not (is_marked(path) or _is_picture_sidecar(path)):
            raise ImageError(
                f"{path}: clpipe did not write this file, and would overwrite it with the cameras "
                "of this folder's pictures; move it, or choose another output directory"
            )


def write_camera_files(
    folder: Path, splits: Mapping[str, str] = MappingProxyType({})
) -> CameraFiles:
    """Write the cameras of an output directory, from its sidecars.

    Args:
        folder: the output directory, or a folder in it.
        splits: "train", "val" or "test" for each picture, by its name in sidecars.

    Raises:
        ImageError: a file cannot be written, or was not written by clpipe.
    """
    check_camera_files(folder)
    skipped: dict[str, list[str]] = defaultdict(list)
    found = sorted(output_pictures(folder, skipped), key=lambda each: each.file)
    texts: dict[str, str] = {}
    for role, model in MODEL_FOLDERS.items():
        of_role = [each for each in found if each.role == role]
        texts |= {
            model + name: text for name, text in file_texts(of_role, model, skipped, splits).items()
        }
    occupied = [name for name in FILES if _is_picture_sidecar(folder / name)]
    for name in (name for name in FILES if name not in occupied):
        path = folder / name
        if name in texts:
            create_parents(path)
            write_atomic(path, texts[name].encode())
            sync_folder(path.parent)
        elif texts:
            path.unlink(missing_ok=True)  # describes pictures that have been removed
    reasons = tuple(
        f"{min(files)} and {len(files) - 1} more are {reason}"
        if len(files) > 1
        else f"{files[0]} is {reason}"
        for reason, files in skipped.items()
        if files
    )
    reasons += tuple(
        f"{folder / name} is the sidecar of a picture, so the cameras are not written to it; give "
        "that image another name"
        for name in occupied
        if name in texts
    )
    written = tuple(name for name in FILES if name in texts and name not in occupied)
    return CameraFiles(written, len(found), reasons)


def file_texts(
    pictures: Sequence[OutputPicture],
    model: str,
    skipped: Mapping[str, list[str]],
    splits: Mapping[str, str],
) -> dict[str, str]:
    """Return the texts of the camera files for pictures of one kind, by file name.

    Args:
        pictures: the pictures, sorted.
        model: the folder of these files, relative to the output directory.
        skipped: receives the names of pictures that are missing in some files, by reason.
        splits: see :func:`write_camera_files`.
    """
    if not pictures:
        return {}
    prefix = "../" * model.count("/")
    posed = [each for each in pictures if each.pose]
    if posed:
        skipped[f"not in {TRANSFORMS} and images.txt, because they need a pose"] += [
            each.file for each in pictures if not each.pose
        ]
    texts = {CAMERAS: cameras_json(pictures, prefix), **colmap(pictures, posed, skipped)}
    if transforms := nerfstudio(posed, prefix, skipped, splits):
        texts[TRANSFORMS] = transforms
    return texts


def _is_picture_sidecar(path: Path) -> bool:
    """Return whether a camera file would overwrite the sidecar of a picture."""
    try:
        return is_sidecar(read_bytes(path))
    except OSError:
        return False
