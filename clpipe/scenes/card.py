"""The dataset card: README, contact sheet, manifest, and the split of each view."""

import csv
import io
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from clpipe.base.about import __version__
from clpipe.base.files import write_new
from clpipe.chain.rendition import Rendition
from clpipe.images.sheet import SHEET_SUFFIXES, contact_sheet
from clpipe.inputs.carry_panorama import DISTANCE
from clpipe.outputs.camera_files import FILES, write_camera_files
from clpipe.scenes.members import PICTURE, Member, members_of, splits_of
from clpipe.scenes.record import RECORD

SHEET, MANIFEST, README = "contact_sheet.jpg", "manifest.csv", "README.md"
MAX_ROWS = 12  # rows of the contact sheet
TRUTH = Rendition("clean").suffix.removeprefix(".")
SPLITS = ("train", "val", "test")

# The contents of carried layers, with axes and units.
LAYER_TEXTS = {
    "depth": "along the viewing axis, in the renders' unit ({unit}); PNGs have thousandths of it",
    "normal": "of unit length, in the renders' axes",
    "flow": "in px of the picture, right and down, to the place of a surface in another frame. "
    "In Blender's Vector, X and Y lead to the previous frame, with Y up. Z and W come from the "
    "next frame",
    "label": "whole numbers, the indices of objects",
    "colour": "linear",
}
DISTANCE_TEXT = (
    "the distance from the camera, in the renders' unit ({unit})"  # depth of a wide lens
)


@dataclass(frozen=True)
class CardContents:
    """The contents of a dataset's card that are not in sidecars.

    Args:
        renders: texts about the renders, by title.
        licence: an SPDX identifier or a sentence; "" is not stated.
        author: the author; "" is not stated.
        unit: the unit of depth and poses.
        words: the words of the command.
    """

    renders: Mapping[str, str]
    licence: str
    author: str
    unit: str
    words: Sequence[str]


def write_card(folder: Path, renders: str, about: CardContents) -> list[Path]:
    """Write the card of a dataset, and the splits of its views, from its contents.

    Args:
        folder: the folder of the dataset.
        renders: the name of the folder of renders in it.
        about: contents that are not in sidecars.

    Returns:
        The files that were written.

    Raises:
        ImageError: a file cannot be read or written.
    """
    members = members_of(folder, renders)
    splits = splits_of(members)
    texts = {
        f"{split}.txt": "".join(f"{view}\n" for view in splits if splits[view] == split)
        for split in SPLITS
    }
    texts[MANIFEST] = _manifest(members, splits)
    written = [folder / name for name in (*texts, README)]
    for path, text in zip(written, texts.values(), strict=False):
        write_new(path, text.encode())
    if sheet := _sheet(folder, members):
        write_new(folder / SHEET, sheet)
        written.append(folder / SHEET)
    split_by_name = {member.name: splits[member.view] for member in members}
    for series in dict.fromkeys(member.folder for member in members):
        write_camera_files(folder / series, split_by_name)
    readme = _readme(folder, members, splits, about, bool(sheet))
    write_new(folder / README, readme.encode())
    return written


def _manifest(members: Sequence[Member], splits: Mapping[str, str]) -> str:
    """Return a CSV of all pictures, with their files and settings."""
    kinds = dict.fromkeys(kind for member in members for kind in member.files)
    names = ("ev", "gain", "exposure_time", "f_number")
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["view", "split", "camera", "iso", *names, *kinds, "render"])
    for member in members:
        files = [member.files.get(kind, "") for kind in kinds]
        metadata = member.metadata.camera, member.metadata.iso
        light = [getattr(member.metadata, name) for name in names]
        row = [member.view, splits[member.view], *metadata, *light, *files, member.render]
        table.writerow(row)
    return text.getvalue()


def _sheet(folder: Path, members: Sequence[Member]) -> bytes | None:
    """Return the contact sheet; None if the pictures have another format than JPEG, PNG, TIFF."""
    by_view: dict[str, dict[str, Member]] = {}
    for member in members:
        by_view.setdefault(member.view, {})[member.folder] = member
    columns = max((list(row) for row in by_view.values()), key=len, default=[])
    complete = {view: row for view, row in by_view.items() if list(row) == columns}
    step = -(-len(complete) // MAX_ROWS) or 1
    rows = list(complete.items())[::step]
    if not rows:
        return None
    shown = [(series, PICTURE) for series in columns]
    if all(TRUTH in row[columns[0]].files for _, row in rows):
        shown.append((columns[0], TRUTH))
    pictures = [[folder / row[series].files[kind] for series, kind in shown] for _, row in rows]
    if not all(path.suffix in SHEET_SUFFIXES for row in pictures for path in row):
        return None
    titles = [series if series and kind == PICTURE else kind for series, kind in shown]
    return contact_sheet(pictures, [view for view, _ in rows], titles)


def _readme(
    folder: Path,
    members: Sequence[Member],
    splits: Mapping[str, str],
    about: CardContents,
    has_sheet: bool,
) -> str:
    """Return the README of a dataset, in Markdown."""
    shown = list(splits.values())
    by_series: dict[str, list[Member]] = {}
    for member in members:
        by_series.setdefault(member.folder, []).append(member)
    rows = [
        f"| `{series or '.'}/` | {_value(group, 'camera')} | {_value(group, 'iso')} | "
        f"{len(group)} | {_value(group, 'size')} | {_range(group, 'ev')} | "
        f"{_range(group, 'exposure_time')} | {_range(group, 'f_number')} | "
        f"{_value(group, 'lens')} | {_value(group, 'variance_text')} |"
        for series, group in by_series.items()
    ]
    metadata = "\n".join(f"- **{name}:** {text}" for name, text in about.renders.items())
    kinds = dict.fromkeys(kind for member in members for kind in member.files)
    camera_files = [n for n in FILES if any((folder / series / n).exists() for series in by_series)]
    cameras = ", ".join(f"`{name}`" for name in camera_files)
    views = f"- {cameras} in each folder: intrinsics and poses for COLMAP and nerfstudio. In "
    views += "`cameras.json`, x_cam = R X + t in OpenCV's axes, and px count from the corner.\n"
    layers = {each["layer"]: each for member in members for each in member.layers}
    truths = "".join(
        f"- `{name}` ({each['kind']}): {_layer_text(name, each['kind']).format(unit=about.unit)}.\n"
        for name, each in layers.items()
        if each["kind"] in LAYER_TEXTS
    )
    carried = (
        f"\n## Carried layers\n\n`NAME.carried.exr` has these layers, warped like the picture. "
        f"`valid` is 1 where all of them are known.\n\n{truths}"
        if layers
        else ""
    )
    sheet = f"![Contact sheet]({SHEET})\n\n" if has_sheet else ""
    words = [Path(word).name if Path(word).is_absolute() else word for word in about.words]
    counts = ", ".join(f"{shown.count(split)} in `{split}.txt`" for split in SPLITS)
    return f"""# {folder.resolve().name}

Made by clpipe {__version__}: renders as pictures of a camera, with its noise.

{sheet}- **Licence:** {about.licence or "not stated (`--licence`)"}
- **Author:** {about.author or "not stated (`--author`)"}
{metadata}
- **Views:** {len(shown)}: {counts}. One in eight is for validation, and one for tests.

| folder | camera | ISO | pictures | size | EV | time, s | f-number | lens | variance of the raw |
|---|---|---|---|---|---|---|---|---|---|
{chr(10).join(rows)}

y is the raw's signal, 1 at the white level. EVs are relative to the render. `photometry` in each
sidecar contains gains, vignetting and the response.

## Files

- `{MANIFEST}`: a row for each picture, with its files ({", ".join(kinds)}), camera, ISO, exposure \
and split. Paths are relative to this folder.
- `NAME.json` next to each picture: all settings that made it. \
`clpipe replay NAME.json` recomputes it, byte for byte.
{views if camera_files else ""}- `{RECORD}`: what the renders were made from. `run.jsonl`: the log.
{carried}
## Made by

```sh
{shlex.join(["clpipe", *words])}
```

The same command makes the same pictures on the same kind of device, and resumes after an \
interruption. With other ISOs, cameras or frames, it adds pictures.
"""


def _value(members: Sequence[Member], fact: str) -> str:
    """Return the value that pictures share, or the first and the number of other values."""
    first, *others = dict.fromkeys(getattr(member.metadata, fact) for member in members)
    return f"{first} and {len(others)} others" if others else str(first)


def _range(members: Sequence[Member], fact: str) -> str:
    """Return the smallest and largest number of some pictures as text."""
    texts = [text for member in members if (text := getattr(member.metadata, fact))]
    if not texts:
        return "not known"
    low, high = min(texts, key=float), max(texts, key=float)
    return low if low == high else f"{low} to {high}"


def _layer_text(layer: str, kind: str) -> str:
    """Return the description of a carried layer."""
    return DISTANCE_TEXT if layer.endswith(f".{DISTANCE}") else LAYER_TEXTS[kind]
