"""The card of a dataset: README, contact sheet, manifest, and which views are for training."""

import csv
import io
import logging
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from clpipe.base.about import __version__
from clpipe.base.files import write_new
from clpipe.chain.rendition import Rendition
from clpipe.images.sheet import SHOWN, contact_sheet
from clpipe.inputs.find import Job
from clpipe.outputs.camera_files import FILES
from clpipe.outputs.sealed import SIDECAR, SidecarError, outputs_in, read_sidecar
from clpipe.outputs.writer import OutputWriter
from clpipe.scenes.record import RECORD

SHEET, MANIFEST, README = "contact_sheet.jpg", "manifest.csv", "README.md"
MOST_ROWS = 12  # of the contact sheet
PICTURE, TRUTH, CARRIED = "picture", Rendition("clean").suffix.removeprefix("."), "carried"

# What is raised for values of a forged sidecar.
DAMAGED = (KeyError, TypeError, ValueError, AttributeError, OverflowError)

log = logging.getLogger(__name__)


class Facts(NamedTuple):
    """What is said of a picture, as texts: its size in px, the variance of the raw's noise."""

    camera: str
    iso: str
    size: str
    law: str


@dataclass(frozen=True)
class Member:
    """What was made of one view with one camera and ISO.

    Args:
        view: the name of its render, without its ending.
        folder: below the dataset's, by camera and ISO; "" is the dataset's own.
        files: paths below the dataset's folder: "picture", "truth_clean" and so on, "carried".
        facts: of the picture.
        render: what it was made of, below the dataset's folder where it lies there.
    """

    view: str
    folder: str
    files: Mapping[str, str]
    facts: Facts
    render: str


def split_of(number: int) -> str:
    """What a view is for: every eighth for validation, from the fourth on; the rest for training.

    >>> [number for number in range(24) if split_of(number) == "val"]
    [3, 11, 19]
    """
    return "val" if number % 8 == 3 else "train"


def write_card(
    writer: OutputWriter, jobs: Sequence[Job], words: Sequence[str], about: Mapping[str, str]
) -> list[Path]:
    """Write the card of a dataset, from its sidecars.

    Args:
        writer: of its pictures.
        jobs: all of them, those of a view one after the other.
        words: the command.
        about: what else its README says: texts by their titles.

    Returns:
        The files.

    Raises:
        ImageError: a file cannot be read or written.
    """
    folder = writer.folder
    members = [member for job in jobs if (member := _member(writer, job))]
    views = dict.fromkeys(_view(job) for job in jobs)
    splits = {view: split_of(number) for number, view in enumerate(views)}
    texts = {
        f"{split}.txt": "".join(f"{view}\n" for view in views if splits[view] == split)
        for split in ("train", "val")
    }
    texts[MANIFEST] = _manifest(members, splits)
    texts[README] = _readme(folder.resolve().name, members, splits, words, about)
    written = [folder / name for name in texts]
    for path, text in zip(written, texts.values(), strict=True):
        write_new(path, text.encode())
    if sheet := _sheet(folder, members):
        write_new(folder / SHEET, sheet)
        written.append(folder / SHEET)
    return written


def _view(job: Job) -> str:
    return Path(job.key).with_suffix("").as_posix()


def _member(writer: OutputWriter, job: Job) -> Member | None:
    """What was made of a job; None where something of it failed, or is not as it was written."""
    files: dict[str, str] = {}
    facts = []
    for rendition in writer.renditions_of(job):
        path = writer.path(job, SIDECAR, rendition)
        try:
            values = read_sidecar(path)
            facts.append(_facts(values))
            first, *others = outputs_in(values)
        except FileNotFoundError:
            return None
        except (SidecarError, *DAMAGED):
            log.warning("%s; the card goes without it", SidecarError(path))
            return None
        place = path.parent.relative_to(writer.folder)
        files.setdefault(rendition.suffix.removeprefix(".") or PICTURE, (place / first).as_posix())
        for each in others:
            if each.endswith(f".{CARRIED}.exr"):
                files[CARRIED] = (place / each).as_posix()
    own = job.stem.removesuffix(_view(job)).rstrip("/")
    below = os.path.relpath(job.path, writer.folder)
    render = job.input if below.startswith("..") else below
    return Member(_view(job), own, files, facts[0], render)


def _facts(values: Mapping[str, Any]) -> Facts:
    """What the card says of a picture, by its sidecar.

    Raises:
        KeyError, TypeError, ValueError, AttributeError, OverflowError: the values are damaged.
    """
    noise = (values["noise"] or {}).get("signal", {"a": 0.0, "b": 0.0})
    size = f"{values['width']:d}x{values['height']:d}"
    law = f"{noise['a']:.3g} y + {noise['b']:.3g}"
    return Facts(str(values["camera"]), f"{values['iso']:g}", size, law)


def _manifest(members: Sequence[Member], splits: Mapping[str, str]) -> str:
    """A table of all pictures, with their files and what they were made with."""
    kinds = dict.fromkeys(kind for member in members for kind in member.files)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["view", "split", "camera", "iso", *kinds, "render"])
    for member in members:
        files = [member.files.get(kind, "") for kind in kinds]
        facts = member.facts.camera, member.facts.iso
        table.writerow([member.view, splits[member.view], *facts, *files, member.render])
    return text.getvalue()


def _sheet(folder: Path, members: Sequence[Member]) -> bytes | None:
    """The contact sheet; None where the pictures are of no kind that is shown."""
    by_view: dict[str, dict[str, Member]] = {}
    for member in members:
        by_view.setdefault(member.view, {})[member.folder] = member
    columns = max((list(row) for row in by_view.values()), key=len, default=[])
    whole = {view: row for view, row in by_view.items() if len(row) == len(columns)}
    step = -(-len(whole) // MOST_ROWS) or 1
    rows = list(whole.items())[::step]
    pictures = [
        [folder / member.files[PICTURE] for member in row.values()]
        + [folder / path for path in _truths(next(iter(row.values())))]
        for _, row in rows
    ]
    if not rows or not all(path.suffix in SHOWN for row in pictures for path in row):
        return None
    titles = [column or PICTURE for column in columns] + list(_truths(rows[0][1][columns[0]], True))
    return contact_sheet(pictures, [view for view, _ in rows], titles)


def _truths(member: Member, names: bool = False) -> list[str]:
    """A view's picture without noise, where there is one; its path or its name."""
    found = [(name, path) for name, path in member.files.items() if name == TRUTH]
    return [name if names else path for name, path in found]


def _readme(
    title: str,
    members: Sequence[Member],
    splits: Mapping[str, str],
    words: Sequence[str],
    about: Mapping[str, str],
) -> str:
    """The README of a dataset, in Markdown."""
    shown = list(splits.values())
    rows = []
    for member in {each.folder: each for each in reversed(members)}.values():
        count = sum(each.folder == member.folder for each in members)
        camera, iso, size, law = member.facts
        rows.append(f"| `{member.folder or '.'}/` | {camera} | {iso} | {count} | {size} | {law} |")
    facts = "\n".join(f"- **{name}:** {text}" for name, text in about.items())
    kinds = dict.fromkeys(kind for member in members for kind in member.files)
    cameras = ", ".join(f"`{name}`" for name in FILES)
    return f"""# {title}

Made by clpipe {__version__}: renders as a camera takes them, with its noise.

![Contact sheet]({SHEET})

{facts}
- **Views:** {len(shown)}: {shown.count("train")} for training (`train.txt`) and \
{shown.count("val")} for validation (`val.txt`), every eighth.

| folder | camera | ISO | pictures | size | variance of the raw's noise |
|---|---|---|---|---|---|
{chr(10).join(reversed(rows))}

y is the raw's signal, 1 at the white level.

## Files

- `{MANIFEST}`: a row for each picture, with its files ({", ".join(kinds)}), camera, ISO and split.
- `NAME.json` beside each picture: everything that it was made with. \
`clpipe replay NAME.json` makes it again, byte for byte.
- {cameras} in each folder, where the cameras are known: intrinsics and poses for COLMAP and \
nerfstudio.
- `{RECORD}`: what the renders were made of. `run.jsonl`: the log.

## Made by

```sh
{shlex.join(["clpipe", *words])}
```

The same command makes the same pictures again on the same kind of device, and goes on where it \
was interrupted.
"""
