"""The images in a report, within a size budget: many thumbnails, and a few for comparison."""

import base64
import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Any

import numpy as np

from clpipe.analysis.crops import HEIGHT, WIDTH, Crop, choose_crops
from clpipe.base.errors import ImageError
from clpipe.base.types import Array
from clpipe.chain.rendition import BASELINES, NOISY, PICTURES
from clpipe.images.preview import decode_8_bit, jpeg_bytes, reduce, thumbnail_bytes
from clpipe.reports.figures import number, oddities
from clpipe.reports.run import Blob, Made, Run

BUDGET = 14 << 20  # bytes of the whole page
SMALL = 160  # px, the longer side of a thumbnail
SMALL_PIXELS = 4e9  # to read for the contact sheet: about a minute of one processor
TOGETHER = 64  # thumbnails in one batch
CHOSEN = 8  # images to compare
LARGE = 1_200_000  # px; larger images are reduced for the comparison
CROP = 320, 240  # px, width and height of full-resolution regions of reduced images
TRUE_QUALITY, REDUCED_QUALITY = 93, 85  # of JPEGs at full and at reduced resolution
PICTURE = "image"  # its label in the comparison
SHOWN = ("jpg", "png", "tif", "tif16", "exr", "npy")


@dataclass
class Budget:
    """The remaining bytes of a page."""

    left: int

    def take(self, text: str) -> bool:
        """Take the bytes of a text. Return False if they exceed the budget."""
        if len(text) > self.left:
            return False
        self.left -= len(text)
        return True


def picture_file(made: Made) -> Blob | None:
    """Return the file of a picture to display: the first one in a supported format."""
    return next((made.files[kind] for kind in SHOWN if kind in made.files), None)


def checked(blob: Blob) -> bytes:
    """Return the bytes of a file after a check against its sidecar.

    Raises:
        ImageError: the file is missing, or its SHA-256 differs from the sidecar.
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


def jpeg_uri(pixels: Array, quality: int = TRUE_QUALITY) -> str:
    """Return (height, width, 3) uint8 as a JPEG in a data URI."""
    return data_uri("jpeg", jpeg_bytes(np.ascontiguousarray(pixels), quality))


def data_uri(kind: str, data: bytes) -> str:
    """Return an image file as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


@dataclass
class Sheet:
    """The contact sheet: entries of images for the script of the page."""

    entries: list[dict[str, Any]] = field(default_factory=list)
    pictures: int = 0  # of the run
    problems: list[str] = field(default_factory=list)


def contact_sheet(
    run: Run, budget: Budget, label: str, tell: Callable[[str], None] = lambda _: None
) -> Sheet:
    """Return thumbnails of a run in its order, limited by the budget and by time.

    Args:
        run: the run.
        budget: the budget that thumbnails use.
        label: a prefix of the image names, or "".
        tell: called with the progress.
    """
    pictures = run.pictures
    sheet = Sheet(pictures=len(pictures))
    entries: dict[int, dict[str, Any]] = {}
    order = telling_order([bool(oddities(made)) for made in pictures])
    for i, image, problem in _small_pictures(pictures, order):
        entry = _entry(pictures[i], image, label)
        if not budget.take(json.dumps(entry)):
            break
        entries[i] = entry
        tell(f"thumbnail {len(entries)} of {len(order)}")
        sheet.problems += [problem] if problem else []
    sheet.entries = [entries[i] for i in sorted(entries)]
    return sheet


def _small_pictures(
    pictures: Sequence[Made], order: Sequence[int]
) -> Iterator[tuple[int, str, str]]:
    """Yield the numbers of pictures, each with its thumbnail or the reason for its absence."""

    def small(i: int) -> tuple[str, str]:
        if not (file := picture_file(pictures[i])):
            return "", ""
        try:
            return data_uri("webp", thumbnail_bytes(checked(file), file.name, SMALL)), ""
        except ImageError as error:
            return "", str(error)

    pixels = 0.0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for start in range(0, len(order), TOGETHER):
            numbers = order[start : start + TOGETHER]
            for i, (image, problem) in zip(numbers, pool.map(small, numbers), strict=True):
                yield i, image, problem
                pixels += number(pictures[i].value("width")) * number(pictures[i].value("height"))
            if pixels >= SMALL_PIXELS:
                return


def _entry(made: Made, image: str, label: str) -> dict[str, Any]:
    """Return the data of a thumbnail for the script of the page."""
    return {
        "name": f"{label}: {made.name}" if label else made.name,
        "image": image,
        "iso": round(number(made.value("iso"))),
        "camera": str(made.value("camera")),
        "clipped": number(made.value("clipped")),
        "odd": oddities(made),
    }


def telling_order(odd: Sequence[bool]) -> list[int]:
    """Return the numbers of pictures in an order of which every prefix is a fair sample.

    Unusual and other pictures alternate while both remain. Both are spread evenly, in the order of
    van der Corput (1935).

    Args:
        odd: whether each picture is unusual.

    >>> telling_order([False, False, True, False, False])
    [2, 0, 3, 1, 4]
    """
    unusual = [i for i, is_odd in enumerate(odd) if is_odd]
    others = [i for i, is_odd in enumerate(odd) if not is_odd]
    pairs = zip_longest(_spread(unusual), _spread(others))
    return [i for pair in pairs for i in pair if i is not None]


def _spread(values: Sequence[int]) -> list[int]:
    bits = max(len(values) - 1, 1).bit_length()
    reversed_bits = (int(f"{i:0{bits}b}"[::-1], 2) for i in range(1 << bits))
    return [values[i] for i in reversed_bits if i < len(values)]


@dataclass
class Large:
    """An image to compare, with its views."""

    name: str
    facts: str
    odd: Sequence[str]
    width: int  # px, of the picture
    height: int
    by: int  # the reduction factor; 1 is full resolution
    places: Sequence[Crop]  # regions of interest; reduced images have these at full resolution
    views: list[dict[str, Any]] = field(default_factory=list)  # label, image, crops
    strip: list[dict[str, str]] = field(default_factory=list)  # thumbnails of kept stages

    @classmethod
    def of(cls, made: Made, pixels: Array) -> "Large":
        """Return an image without views.

        Args:
            made: the picture.
            pixels: (height, width, 3) uint8.
        """
        height, width = pixels.shape[:2]
        by = math.ceil((height * width / LARGE) ** 0.5)
        places = places_of(pixels, by)
        return cls(made.name, _facts(made), oddities(made), width, height, by, places)

    def add(self, label: str, pixels: Array, budget: Budget) -> bool:
        """Add a view. Return False if it exceeds the budget.

        Args:
            label: the label of the view.
            pixels: (height, width, 3) uint8, as large as the picture.
            budget: the budget that the view uses.
        """
        if self.by > 1:
            image = jpeg_uri(reduce(pixels, self.by), REDUCED_QUALITY)
            crops = [jpeg_uri(place.of(pixels)) for place in self.places]
        else:
            image, crops = jpeg_uri(pixels), []
        if not budget.take(image + "".join(crops)):
            return False
        self.views.append({"label": label, "image": image, "crops": crops})
        return True


def places_of(pixels: Array, by: int) -> list[Crop]:
    """Return regions of interest of a picture.

    Args:
        pixels: (height, width, 3) uint8.
        by: the reduction factor, as in :class:`Large`. The search uses the reduced picture. Regions
            of reduced pictures are enlarged to CROP px.
    """
    height, width = pixels.shape[:2]
    small = reduce(pixels, by)
    if small.shape[1] < WIDTH or small.shape[0] < HEIGHT:
        found = [Crop("middle", 0, 0, small.shape[1], small.shape[0])]
    else:
        found = choose_crops((), small.astype(np.float32) / np.float32(255))
    if by == 1:
        return found
    wide, high = min(CROP[0], width), min(CROP[1], height)
    return [
        replace(
            place,
            left=min(max(by * (2 * place.left + place.width) // 2 - wide // 2, 0), width - wide),
            top=min(max(by * (2 * place.top + place.height) // 2 - high // 2, 0), height - high),
            width=wide,
            height=high,
        )
        for place in found
    ]


def chosen(run: Run, names: Collection[str]) -> list[Made]:
    """Return the images to compare: given and unusual ones first, then an even sample."""
    pictures = [made for made in run.pictures if picture_file(made)]
    odd = [made for made in pictures if made.name in names or oddities(made)][: CHOSEN // 2]
    others = [made for made in pictures if made not in odd]
    count = min(CHOSEN - len(odd), len(others))
    return odd + [others[i * len(others) // count] for i in range(count)]


def large(
    runs: Sequence[Run], labels: Sequence[str], made: Made, budget: Budget, problems: list[str]
) -> Large | None:
    """Return one image to compare. None if no view of it can be shown.

    Args:
        runs: the run of the image, and a second run that may have the same picture.
        labels: the labels of the runs.
        made: the picture.
        budget: the budget that views use.
        problems: gets the errors of views.
    """
    shown: Large | None = None
    comparison = [(label, file) for label, file in _beside(runs[0], made) if len(runs) == 1]
    views = [
        (" ".join(filter(None, (label, view))), file)
        for label, run in zip(labels, runs, strict=True)
        if (own := run.picture_beside(made))
        for view, file in _views(run, own)
    ]
    views.sort(key=lambda view: not view[0].endswith(PICTURE))
    for label, file in views if len(views) > 1 else views + comparison:
        try:
            pixels = decode_8_bit(checked(file), file.name)
        except ImageError as error:
            problems.append(str(error))
            continue
        shown = shown or Large.of(made, pixels)
        if pixels.shape[:2] != (shown.height, shown.width):
            problems.append(f"{file.name}: its size differs from {made.name}")
        elif not shown.add(label, pixels, budget):
            return None
    if shown:
        shown.strip = _strip(made, budget, problems)
    return shown


def _views(run: Run, made: Made) -> Iterator[tuple[str, Blob]]:
    """Yield the picture, its truths and its baselines, with their labels."""
    if file := picture_file(made):
        yield PICTURE, file
    for rendition, other in run.of_image(made.image).items():
        is_shown = rendition.role in (*PICTURES, *BASELINES) and rendition.ev == made.rendition.ev
        if is_shown and (file := picture_file(other)):
            yield rendition.label.strip("."), file


def _beside(run: Run, made: Made) -> Iterator[tuple[str, Blob]]:
    """Yield a picture to compare with one without truths, and its label.

    It is a picture of the same file with another ISO, exposure or frame. Otherwise it is the
    neighbour in a sequence, whose name differs only in digits.
    """
    alike = [
        other
        for other in run.made
        if other is not made
        and other.rendition.role == NOISY
        and other.value("sha256") == made.value("sha256")
        and all(other.value(key) == made.value(key) for key in ("width", "height"))
    ]
    pictures = run.pictures
    number_of = pictures.index(made)
    near = pictures[number_of - 1 if number_of else 1 : number_of or 2]
    alike += [each for each in near if _without_digits(each.name) == _without_digits(made.name)]
    for other in alike[:1]:
        if file := picture_file(other):
            iso = f"{number(other.value('iso')):.0f}"
            yield f"{other.name} ({other.value('camera')}, ISO {iso})", file


def _without_digits(name: str) -> str:
    return re.sub(r"\d+", "", name)


def _kept(made: Made) -> Iterator[tuple[str, Blob]]:
    """Yield the kept stages of a picture in the order of its chain."""
    for name in (str(step.get("name")) for step in made.steps):
        if file := made.files.get(f"{name}.exr") or made.files.get(f"{name}.npy"):
            yield name, file


def add_stages(shown: Large, made: Made, budget: Budget) -> None:
    """Add the kept stages of a picture as views, within the budget.

    Stages of another size, before the picture is resized, are skipped. Unreadable files are
    reported with the thumbnails.
    """
    for name, file in _kept(made):
        try:
            pixels = decode_8_bit(checked(file), file.name)
        except ImageError:
            continue
        is_alike = pixels.shape[:2] == (shown.height, shown.width)
        if is_alike and not shown.add(f"after {name}", pixels, budget):
            return


def _strip(made: Made, budget: Budget, problems: list[str]) -> list[dict[str, str]]:
    """Return thumbnails of the kept stages of a picture in the order of its chain."""
    strip = []
    for name, file in _kept(made):
        try:
            image = data_uri("webp", thumbnail_bytes(checked(file), file.name, 2 * SMALL))
        except ImageError as error:
            problems.append(str(error))
            continue
        if budget.take(image):
            strip.append({"label": name, "image": image})
    return strip


def _facts(made: Made) -> str:
    """Return a line of facts about a picture."""
    a, b = (number(made.value("noise", "signal", key)) for key in "ab")
    law = f", noise variance {a:.3g} y + {b:.3g} (in squared signal, y from 0 to 1)"
    size = f"{number(made.value('width')):.0f} x {number(made.value('height')):.0f} px"
    iso, clipped = number(made.value("iso")), number(made.value("clipped"))
    lens = f" with {made.value('lens')}" if made.value("lens") else ""
    text = f"{size}, {made.value('camera')}{lens}, ISO {iso:.0f}, {clipped * 100:.2f} % clipped"
    return text + (law if made.value("noise", "signal") else "")
