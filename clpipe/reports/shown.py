"""The pictures that a report holds, within a budget: small ones of many, large ones of a few."""

import base64
import hashlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from clpipe.base.errors import ImageError
from clpipe.images.preview import decoded, jpeg_bytes, thumbnail_bytes
from clpipe.outputs.renditions import baseline_named, truth_named
from clpipe.reports.figures import number, oddities
from clpipe.reports.run import Blob, Made, Run

BUDGET = 14 << 20  # bytes of the whole page
SMALL = 160  # px, the longer side of a picture on the contact sheet
SMALL_SHARE = 0.4  # of the budget, for the contact sheet
CHOSEN = 8  # images that are shown large
LARGE = 1_200_000  # px, of a picture that is shown large
PICTURE = "picture"  # its label, beside truths and baselines
SHOWN = ("jpg", "png", "tif", "tif16", "exr", "npy")


@dataclass
class Budget:
    """How many bytes of a page may still be taken."""

    left: int

    def take(self, text: str) -> bool:
        """Take the bytes of a text; False where there are not enough."""
        if len(text) > self.left:
            return False
        self.left -= len(text)
        return True


def picture_file(made: Made) -> Blob | None:
    """The file of a picture that can be shown: the first in a format for display."""
    return next((made.files[kind] for kind in SHOWN if kind in made.files), None)


def checked(blob: Blob) -> bytes:
    """The bytes of a file, as its sidecar says them.

    Raises:
        ImageError: it is gone, or is another than its sidecar says, by its SHA-256.
    """
    if blob.problem:
        raise ImageError(blob.problem)
    try:
        data = blob.read()
    except OSError as error:
        raise ImageError(f"{blob.name}: cannot be read: {error.strerror}") from None
    if hashlib.sha256(data).hexdigest() != blob.said["sha256"]:
        raise ImageError(f"{blob.name}: was changed since; its SHA-256 is not that of its sidecar")
    return data


def data_uri(data: bytes) -> str:
    """A JPEG as an address that holds it."""
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


@dataclass
class Sheet:
    """The contact sheet: entries of pictures, for the page's script."""

    entries: list[dict[str, Any]] = field(default_factory=list)
    pictures: int = 0  # of the run
    problems: list[str] = field(default_factory=list)


def contact_sheet(run: Run, budget: Budget, label: str) -> Sheet:
    """Small pictures of a run: all, or those with something unusual and others evenly between.

    Args:
        run: the run.
        budget: that it takes from.
        label: stands before the names of its pictures; "" does not.
    """
    pictures = run.pictures
    sheet = Sheet(pictures=len(pictures))
    room = Budget(int(budget.left * SMALL_SHARE))
    for made in spread(pictures, room.left // 4_000):
        file = picture_file(made)
        image, size = "", (number(made.value("width")), number(made.value("height")))
        if file:
            try:
                image = data_uri(thumbnail_bytes(checked(file), file.name, SMALL))
            except ImageError as error:
                sheet.problems.append(str(error))
        if not room.take(image):
            break
        sheet.entries.append(
            {
                "name": f"{label}: {made.name}" if label else made.name,
                "image": image,
                "iso": number(made.value("iso")),
                "camera": str(made.value("camera")),
                "clipped": number(made.value("clipped")),
                "size": f"{size[0]:.0f} x {size[1]:.0f}",
                "odd": oddities(made),
            }
        )
    budget.left -= int(budget.left * SMALL_SHARE) - room.left
    return sheet


def spread(pictures: Sequence[Made], most: int) -> list[Made]:
    """At most so many pictures, in their order: those with oddities first, others evenly."""
    if len(pictures) <= most:
        return list(pictures)
    odd = [i for i, made in enumerate(pictures) if oddities(made)][: most // 2]
    step = len(pictures) / max(most - len(odd), 1)
    chosen = {*odd, *(int(i * step) for i in range(most - len(odd)))}
    return [pictures[i] for i in sorted(chosen)]


@dataclass
class Large:
    """An image that is shown large: the picture and what there is beside it."""

    name: str
    facts: str
    odd: Sequence[str]
    width: int
    height: int
    views: list[dict[str, str]] = field(default_factory=list)  # label and image
    share: str = ""  # what part of the picture is shown; "" is all of it
    strip: list[dict[str, str]] = field(default_factory=list)  # kept stages, from the mosaic on


def chosen(run: Run, names: Collection[str]) -> list[Made]:
    """The images that are shown large: those of these names and unusual ones, then some evenly."""
    pictures = [made for made in run.pictures if picture_file(made)]
    odd = [made for made in pictures if made.name in names or oddities(made)][: CHOSEN // 2]
    others = [made for made in pictures if made not in odd]
    count = min(CHOSEN - len(odd), len(others))
    return odd + [others[i * len(others) // count] for i in range(count)]


def large(
    runs: Sequence[Run], labels: Sequence[str], made: Made, budget: Budget, problems: list[str]
) -> Large | None:
    """One image, as it is shown large; None where nothing of it can be shown.

    Args:
        runs: the run that it is of, and another that may have the same picture.
        labels: of the runs.
        made: its picture.
        budget: that it takes from.
        problems: gets what cannot be shown, and why.
    """
    shown: Large | None = None
    views = [
        (" ".join(filter(None, (label, view))), file)
        for label, run in zip(labels, runs, strict=True)
        if (own := run.picture_of(made.image))
        for view, file in _views(run, own)
    ]
    for label, file in sorted(views, key=lambda view: not view[0].endswith(PICTURE)):
        try:
            pixels, share = part_of(decoded(checked(file), file.name))
        except ImageError as error:
            problems.append(str(error))
            continue
        height, width = pixels.shape[:2]
        if shown is None:
            shown = Large(made.name, _facts(made), oddities(made), width, height, share=share)
        elif (height, width) != (shown.height, shown.width):
            problems.append(f"{file.name}: is of another size than {made.name}")
            continue
        image = data_uri(jpeg_bytes(pixels))
        if not budget.take(image):
            return None
        shown.views.append({"label": label, "image": image})
    if shown:
        shown.strip = _strip(made, budget, problems)
    return shown


def part_of(pixels: Any) -> tuple[Any, str]:
    """The middle of a picture, at most LARGE px of it, and what it is in words."""
    height, width = pixels.shape[:2]
    if height * width <= LARGE:
        return pixels, ""
    scale = (LARGE / (height * width)) ** 0.5
    rows, columns = max(int(height * scale), 1), max(int(width * scale), 1)
    top, left = (height - rows) // 2, (width - columns) // 2
    part = pixels[top : top + rows, left : left + columns]
    return part, f"its middle, {columns} x {rows} of {width} x {height} px"


def _views(run: Run, made: Made) -> Iterator[tuple[str, Blob]]:
    """The picture, its truths and its baselines, with their labels."""
    if file := picture_file(made):
        yield PICTURE, file
    exposure = made.rendition.partition(".frame")[0]
    for rendition, other in run.of_image(made.image).items():
        kind = truth_named(rendition) or baseline_named(rendition)
        of_it = rendition.startswith(exposure) and kind not in ("mosaic", "variance")
        if kind and of_it and (file := picture_file(other)):
            yield rendition.removeprefix(exposure).strip("."), file


def _kept(made: Made) -> Iterator[tuple[str, Blob]]:
    """The kept stages of a picture, in the order of its chain."""
    for name in (str(step.get("name")) for step in made.steps):
        if file := made.files.get(f"{name}.exr") or made.files.get(f"{name}.npy"):
            yield name, file


def add_stages(shown: Large, made: Made, budget: Budget) -> None:
    """Show the kept stages of a picture large, too, as far as the budget goes.

    Those of another size, before a picture is made smaller, are left out. What cannot be read is
    known from the small ones.
    """
    for name, file in _kept(made):
        try:
            pixels, _ = part_of(decoded(checked(file), file.name))
        except ImageError:
            continue
        if pixels.shape[:2] != (shown.height, shown.width):
            continue
        image = data_uri(jpeg_bytes(pixels))
        if not budget.take(image):
            return
        shown.views.append({"label": f"after {name}", "image": image})


def _strip(made: Made, budget: Budget, problems: list[str]) -> list[dict[str, str]]:
    """The kept stages of a picture, small, in the order of its chain."""
    strip = []
    for name, file in _kept(made):
        try:
            image = data_uri(thumbnail_bytes(checked(file), file.name, 2 * SMALL))
        except ImageError as error:
            problems.append(str(error))
            continue
        if budget.take(image):
            strip.append({"label": name, "image": image})
    return strip


def _facts(made: Made) -> str:
    """A line about a picture."""
    noise = made.value("noise", "signal") or {}
    law = f"; variance {number(noise.get('a')):.3g} y + {number(noise.get('b')):.3g}"
    size = f"{number(made.value('width')):.0f} x {number(made.value('height')):.0f} px"
    iso, clipped = number(made.value("iso")), number(made.value("clipped"))
    text = f"{size}, {made.value('camera')}, ISO {iso:g}, {clipped:.2%} clipped"
    return text + (law if noise else "")
