"""The contents of an output directory: pictures from sidecars in it and in its tars, and logs."""

import os
import tarfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from clpipe.base.errors import RequestError
from clpipe.base.reading import TEXT_BYTES, read_bytes
from clpipe.batch.run_log import read_log
from clpipe.batch.tars import DAMAGED
from clpipe.chain.keys import KEYS as SINGLE
from clpipe.chain.rendition import Rendition
from clpipe.outputs.record import whole_step
from clpipe.outputs.shared import with_shared
from clpipe.outputs.sidecar import SIDECAR, SidecarError, output_entries, parse_sidecar

TAR = ".tar"
# The values of sidecars to keep. There may be hundreds of thousands of sidecars.
KEYS = (
    *("clpipe", "sha256", "iso", "camera", "lens", "width", "height", "noise", "clipped"),
    "warnings",
)
SHARED_KEYS = ("device", "versions")  # keys whose values are equal in most sidecars
CLIPS = (".mp4", ".mkv")
LOGS = "run*.jsonl"


@dataclass(frozen=True, slots=True)
class Blob:
    """A file or a member of a tar, and its record in the sidecar."""

    path: str
    name: str  # path in the output directory; for a member, the tar's path and the member's name
    sidecar_entry: Mapping[str, Any]  # its size and SHA-256
    offset: int | None = None  # offset of a member in its tar
    size: int = -1  # the actual size; -1 is a missing file

    def read(self) -> bytes:
        """Return the bytes.

        Raises:
            OSError: the file cannot be read.
        """
        with open(self.path, "rb") as file:
            file.seek(self.offset or 0)
            return file.read(self.size)

    @property
    def problem(self) -> str:
        """The problem of the file according to its size, or ""."""
        if self.size < 0:
            return f"{self.name}: is missing"
        if self.size != self.sidecar_entry["size"]:
            expected = self.sidecar_entry["size"]
            return f"{self.name}: has {self.size} bytes, not the {expected} of its sidecar"
        return ""


@dataclass(frozen=True, eq=False)
class RunPicture:
    """One picture of a run, from its sidecar: an image, a frame, a truth or a baseline."""

    image: str  # the name of its input without extension, with directories of a series
    rendition: Rendition
    record: dict[str, Any]  # the needed part of the sidecar; equal parts are shared
    files: Mapping[str, Blob]  # files by suffix, for example jpg or demosaic.exr

    @property
    def name(self) -> str:
        """The name of the picture without extension."""
        return self.image + self.rendition.suffix

    @property
    def steps(self) -> Sequence[Mapping[str, Any]]:
        """The steps of its chain."""
        found: list[Mapping[str, Any]] = self.record["stages"]
        return found

    def value(self, *keys: str) -> Any:
        """Return a value of the sidecar by nested keys. None if absent."""
        found: Any = self.record
        for key in keys:
            found = found.get(key) if isinstance(found, dict) else None
        return found


@dataclass
class Run:
    """The contents of an output directory."""

    folder: Path
    all_pictures: list[RunPicture] = field(default_factory=list)
    logs: list[Mapping[str, Any]] = field(default_factory=list)  # lines of all logs
    problems: list[str] = field(default_factory=list)  # problems of sidecars, tars and logs

    @property
    def pictures(self) -> Sequence[RunPicture]:
        """The noisy pictures in the order of their names. Bursts count with the first frame."""
        return [each for each in self.all_pictures if each.rendition.is_first]

    def of_image(self, image: str) -> Mapping[Rendition, RunPicture]:
        """Return all pictures of an image by rendition."""
        return self._by_image.get(image, {})

    def matching_picture(self, other: RunPicture) -> RunPicture | None:
        """Return the picture, or first frame, with the image and exposure of another one."""
        return next(
            (
                picture
                for rendition, picture in self.of_image(other.image).items()
                if rendition.is_first and rendition.ev == other.rendition.ev
            ),
            None,
        )

    def __post_init__(self) -> None:
        self._by_image: dict[str, dict[Rendition, RunPicture]] = {}
        self._alike: dict[str, Any] = {}

    def reduced_record(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of a sidecar to keep. Equal devices and steps become one object."""
        steps = record.get("stages")
        steps = steps if isinstance(steps, list) else []
        requested, shared = requested_values(record.get("request")), self._alike.setdefault
        kept = {key: record.get(key) for key in KEYS}
        kept |= {key: shared(repr(record.get(key)), record.get(key)) for key in SHARED_KEYS}
        kept["asked"] = shared(repr(sorted(requested)), requested)
        dicts = {repr(step): step for step in steps if isinstance(step, dict)}
        kept["stages"] = [
            self._alike.get(text) or shared(text, whole_step(step)) for text, step in dicts.items()
        ]
        return kept

    def add(self, picture: RunPicture) -> None:
        """Add a picture."""
        self.all_pictures.append(picture)
        self._by_image.setdefault(picture.image, {})[picture.rendition] = picture


def requested_values(request: Any) -> frozenset[str]:
    """Return the names of values that a request draws, or sets for its image only.

    >>> config = {"iso": {"choice": [100, 200]}, "denoise": {"luma_strength": 1}}
    >>> sorted(requested_values({"config": config, "image": {"x": {"y": 2}}}))
    ['iso', 'x.y']
    """
    tables = request if isinstance(request, Mapping) else {}
    found = set()
    for part in ("config", "options", "image"):
        table = tables.get(part)
        for key, value in table.items() if isinstance(table, Mapping) else ():
            named = {key: value}
            if key not in SINGLE and isinstance(value, Mapping):
                named = {f"{key}.{name}": each for name, each in value.items()}
            found |= {
                name for name, each in named.items() if part == "image" or isinstance(each, Mapping)
            }
    return frozenset(found)


def read_run(folder: Path) -> Run:
    """Read an output directory of a finished or unfinished run.

    Raises:
        RequestError: it is not a directory, or has no sidecars or logs of clpipe.
    """
    if not folder.is_dir():
        raise RequestError(f"{folder}: it is not a directory. Name the output directory of a run")
    run = Run(folder)
    found = sorted(_in_folder(run), key=lambda picture: (picture.image, picture.rendition.suffix))
    for picture in found:
        run.add(picture)
    for path in sorted(folder.glob(LOGS)):
        if path.with_suffix("").suffix in CLIPS:
            continue  # the records of a clip
        try:
            run.logs += read_log(path)
        except (OSError, ValueError) as error:
            run.problems.append(f"{path.name}: cannot be read: {error}")
    if not run.all_pictures and not run.logs:
        raise RequestError(
            f"{folder}: has no picture of clpipe with its sidecar (NAME.json), and no log "
            "(run.jsonl). Name the output directory of clpipe run"
        )
    clips = [path for suffix in CLIPS for path in folder.glob(f"**/*{suffix}")]
    if clips and not run.all_pictures:
        raise RequestError(
            f"{folder}: its pictures are in clips, such as {clips[0].name}, but a report needs "
            "single pictures. To write them, run the frames with --sequence and --format png"
        )
    return run


def _in_folder(run: Run) -> Iterator[RunPicture]:
    """Yield the pictures of the output directory and of its tars."""
    for parent, folders, names in os.walk(run.folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        folder = Path(parent).relative_to(run.folder).as_posix()
        siblings: dict[str, Blob] = {}
        for name in sorted(names):
            if name.startswith("."):
                continue
            if name.endswith(TAR):
                yield from _in_tar(run, Path(parent, name))
            elif name.endswith(f".{SIDECAR}"):
                try:
                    data = read_bytes(Path(parent, name))
                except OSError as error:
                    run.problems.append(f"{_joined(folder, name)}: cannot be read: {error}")
                    continue
                siblings = siblings or _files(parent, folder)
                yield from _read_picture(run, folder, name, data, siblings, Path(parent))


def _files(path: str, folder: str) -> dict[str, Blob]:
    """Return the files of a directory by name."""
    with os.scandir(path) as entries:
        return {
            entry.name: Blob(
                entry.path, _joined(folder, entry.name), {}, None, entry.stat().st_size
            )
            for entry in entries
            if entry.is_file()
        }


def _in_tar(run: Run, path: Path) -> Iterator[RunPicture]:
    """Yield the pictures of a tar."""
    label = path.relative_to(run.folder).as_posix()
    siblings: dict[str, dict[str, Blob]] = defaultdict(dict)  # by folder and name
    sidecars: list[tuple[str, str, bytes]] = []
    try:
        with tarfile.open(path, "r:") as tar:
            for member in tar:
                if not member.isfile():
                    continue
                at = PurePosixPath(member.name)
                name, folder = at.name, str(at.parent)
                location = member.offset_data, member.size
                siblings[folder][name] = Blob(str(path), f"{label}/{member.name}", {}, *location)
                is_text = name.endswith(f".{SIDECAR}") and member.size <= TEXT_BYTES
                if is_text and (file := tar.extractfile(member)):
                    sidecars.append((folder, name, file.read()))
    except DAMAGED as error:
        run.problems.append(f"{label}: cannot be read to its end: {error}")
    for folder, name, data in sidecars:
        yield from _read_picture(run, folder, name, data, siblings[folder], path.parent)


def _read_picture(
    run: Run, folder: str, name: str, data: bytes, siblings: Mapping[str, Blob], shared_folder: Path
) -> Iterator[RunPicture]:
    """Yield the picture of a sidecar, unless the sidecar is damaged or not from clpipe.

    Args:
        run: gets the problem.
        folder: the directory of the sidecar, relative to the output directory or the tar.
        name: the file name of the sidecar.
        data: its bytes.
        siblings: the files of the directory, by name.
        shared_folder: the folder of the values that its run shares.
    """
    try:
        record = parse_sidecar(data, _joined(folder, name))
        record = record and with_shared(record, shared_folder)
    except SidecarError as error:
        run.problems.append(str(error))
        return
    if record is None:
        return
    stem = name.removesuffix(f".{SIDECAR}")
    try:
        rendition = Rendition.from_record(record)
    except (KeyError, TypeError, ValueError):
        rendition = None
    if not rendition or not stem.endswith(rendition.suffix):
        run.problems.append(f"{_joined(folder, name)}: is damaged, or of another version")
        return
    files = {}
    for file, sidecar_entry in output_entries(record).items():
        found = siblings.get(file, Blob("", _joined(folder, file), {}))
        files[file.removeprefix(f"{stem}.")] = replace(found, sidecar_entry=sidecar_entry)
    image = _joined(folder, stem.removesuffix(rendition.suffix))
    yield RunPicture(image, rendition, run.reduced_record(record), files)


def _joined(folder: str, name: str) -> str:
    return name if folder == "." else f"{folder}/{name}"
