"""The views of an output folder, from its sidecars: cameras.json, COLMAP's text model and
nerfstudio's transforms.json.

The pictures are sorted by their names, so the same sidecars make the same bytes in any order.
"""

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from clpipe.base.errors import ImageError
from clpipe.base.files import keep_names, make_folder_of, write_whole
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
    """What was written of a folder's views.

    Args:
        files: by their paths in the folder; none where no picture's intrinsics are known.
        pictures: how many are in them.
        left_out: what is not in all of them and why, as texts.
    """

    files: tuple[str, ...]
    pictures: int
    left_out: tuple[str, ...]

    def lines(self, folder: Path) -> list[str]:
        """The same for people; ``folder`` is the one that it was written to."""
        warnings = [f"warning: {each}" for each in self.left_out]
        if not self.files:
            return warnings
        shown = dict.fromkeys("/".join(name.split("/")[:2]) for name in self.files)
        files = ", ".join(str(folder / name) for name in shown)
        return [f"wrote {files}: {self.pictures} picture{'s' * (self.pictures != 1)}", *warnings]


def check_camera_files(folder: Path) -> None:
    """See that the files of a folder's views may be written.

    Raises:
        ImageError: one of their names is somebody else's.
    """
    for path in (folder / name for name in FILES):
        if os.path.lexists(path) and not (is_marked(path) or _is_taken(path)):
            raise ImageError(
                f"{path}: clpipe did not write this file, and would overwrite it with the cameras "
                "of this folder's pictures; move it, or choose another output folder"
            )


def write_camera_files(folder: Path, splits: Mapping[str, str] = MappingProxyType({})) -> Written:
    """Write the views of an output folder, as its sidecars say them.

    Args:
        folder: the output folder, or a part of it.
        splits: what pictures are for, by the names that sidecars have.

    Raises:
        ImageError: a file cannot be written or is somebody else's.
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
            make_folder_of(path)
            write_whole(path, texts[name].encode())
            keep_names(path.parent)
        elif texts:
            path.unlink(missing_ok=True)  # of pictures that have gone
    reasons = tuple(
        f"{why}: {len(files)} picture{'s' * (len(files) > 1)}, such as {min(files)}"
        for why, files in left_out.items()
        if files
    )
    reasons += tuple(
        f"{folder / name} is the sidecar of a picture, so the cameras are not written there; give "
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
    """The files of pictures of one kind, by their names.

    Args:
        pictures: sorted.
        model: the folder that the files are for, below the pictures' own.
        left_out: gets the names of those that are not in all of them, by the reason.
        splits: see :func:`write_camera_files`.
    """
    if not pictures:
        return {}
    up = "../" * model.count("/")
    posed = [each for each in pictures if each.pose]
    if posed:
        left_out[f"no pose, so not in {TRANSFORMS} and images.txt"] += [
            each.file for each in pictures if not each.pose
        ]
    texts = {CAMERAS: cameras_json(pictures, up), **colmap(pictures, posed, left_out)}
    if nerf := nerfstudio(posed, up, left_out, splits):
        texts[TRANSFORMS] = nerf
    return texts


def _is_taken(path: Path) -> bool:
    """Whether a file of the views would take the place of a picture's sidecar."""
    try:
        return is_sidecar(read_bytes(path))
    except OSError:
        return False
