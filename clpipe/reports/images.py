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
from clpipe.base.reading import read_errors
from clpipe.base.types import Array
from clpipe.chain.rendition import BASELINES, NOISY, PICTURES
from clpipe.images.preview import decode_8_bit, jpeg_bytes, reduce, thumbnail_bytes
from clpipe.reports.figures import anomalies, number
from clpipe.reports.run import Blob, Run, RunPicture

BUDGET = 14 << 20  # bytes of the whole page
THUMBNAIL_SIZE = 160  # px, the longer side of a thumbnail
MAX_THUMBNAIL_PIXELS = 4e9  # read for all thumbnails; they take one processor about a minute
BATCH_SIZE = 64  # thumbnails in one batch
MAX_COMPARED = 8  # the most images that can be compared
MAX_COMPARED_PIXELS = 1_200_000  # px; larger images are reduced for the comparison
CROP = 320, 240  # px, width and height of full-resolution regions of reduced images
TRUE_QUALITY, REDUCED_QUALITY = 93, 85  # quality of JPEGs at full and at reduced resolution
PICTURE = "image"  # label of the picture in the comparison
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


def picture_file(picture: RunPicture) -> Blob | None:
    """Return the file of a picture to display: the first one in a supported format."""
    return next((picture.files[kind] for kind in SHOWN if kind in picture.files), None)


def checked(blob: Blob) -> bytes:
    """Return the bytes of a file after a check against its sidecar.

    Raises:
        ImageError: the file is missing, or its SHA-256 differs from the sidecar.
    """
    if blob.problem:
        raise ImageError(blob.problem)
    with read_errors(blob.name):
        data = blob.read()
    if hashlib.sha256(data).hexdigest() != blob.sidecar_entry["sha256"]:
        raise ImageError(
            f"{blob.name}: has changed since the run; its SHA-256 differs from its sidecar"
        )
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
    pictures: int = 0  # pictures of the run
    problems: list[str] = field(default_factory=list)


def contact_sheet(
    run: Run, budget: Budget, label: str, report_progress: Callable[[str], None] = lambda _: None
) -> Sheet:
    """Return thumbnails of a run in its order, limited by the budget and by time.

    Args:
        run: the run.
        budget: the budget that thumbnails use.
        label: a prefix of the image names, or "".
        report_progress: called with the progress.
    """
    pictures = run.pictures
    sheet = Sheet(pictures=len(pictures))
    entries: dict[int, dict[str, Any]] = {}
    order = sample_order([bool(anomalies(picture)) for picture in pictures])
    for i, image, problem in _small_pictures(pictures, order):
        entry = _entry(pictures[i], image, label)
        if not budget.take(json.dumps(entry)):
            break
        entries[i] = entry
        report_progress(f"thumbnail {len(entries)} of {len(order)}")
        sheet.problems += [problem] if problem else []
    sheet.entries = [entries[i] for i in sorted(entries)]
    return sheet


def _small_pictures(
    pictures: Sequence[RunPicture], order: Sequence[int]
) -> Iterator[tuple[int, str, str]]:
    """Yield the numbers of pictures, each with its thumbnail or the reason for its absence."""

    def small(i: int) -> tuple[str, str]:
        file = picture_file(pictures[i])
        return _thumbnail(file, THUMBNAIL_SIZE) if file else ("", "")

    pixels = 0.0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for start in range(0, len(order), BATCH_SIZE):
            numbers = order[start : start + BATCH_SIZE]
            for i, (image, problem) in zip(numbers, pool.map(small, numbers), strict=True):
                yield i, image, problem
                pixels += number(pictures[i].value("width")) * number(pictures[i].value("height"))
            if pixels >= MAX_THUMBNAIL_PIXELS:
                return


def _thumbnail(file: Blob, side: int) -> tuple[str, str]:
    """Return a thumbnail as a data URI and "", or "" and the reason for its absence."""
    try:
        return data_uri("webp", thumbnail_bytes(checked(file), file.name, side)), ""
    except ImageError as error:
        return "", str(error)


def _entry(picture: RunPicture, image: str, label: str) -> dict[str, Any]:
    """Return the data of a thumbnail for the script of the page."""
    return {
        "name": f"{label}: {picture.name}" if label else picture.name,
        "image": image,
        "iso": round(number(picture.value("iso"))),
        "camera": str(picture.value("camera")),
        "clipped": number(picture.value("clipped")),
        "odd": anomalies(picture),
    }


def sample_order(flags: Sequence[bool]) -> list[int]:
    """Return the indices of pictures in an order whose every prefix is a fair sample.

    Unusual and other pictures alternate while both remain. Both are spread evenly, in the order of
    van der Corput (1935).

    Args:
        flags: whether each picture is unusual.

    >>> sample_order([False, False, True, False, False])
    [2, 0, 3, 1, 4]
    """
    unusual = [i for i, is_unusual in enumerate(flags) if is_unusual]
    others = [i for i, is_unusual in enumerate(flags) if not is_unusual]
    pairs = zip_longest(_spread(unusual), _spread(others))
    return [i for pair in pairs for i in pair if i is not None]


def _spread(values: Sequence[int]) -> list[int]:
    bits = max(len(values) - 1, 1).bit_length()
    reversed_bits = (int(f"{i:0{bits}b}"[::-1], 2) for i in range(1 << bits))
    return [values[i] for i in reversed_bits if i < len(values)]


@dataclass
class ComparedImage:
    """An image of the comparison, with its views."""

    name: str
    facts: str
    unusual: Sequence[str]
    width: int  # px; the width of the picture
    height: int
    reduction: int  # the reduction factor; 1 is full resolution
    places: Sequence[Crop]  # regions of interest; reduced images have these at full resolution
    views: list[dict[str, Any]] = field(default_factory=list)  # each: label, image and crops
    stage_thumbnails: list[dict[str, str]] = field(default_factory=list)

    @classmethod
    def of(cls, picture: RunPicture, pixels: Array) -> "ComparedImage":
        """Return an image without views.

        Args:
            picture: the picture.
            pixels: (height, width, 3) uint8.
        """
        height, width = pixels.shape[:2]
        reduction = math.ceil((height * width / MAX_COMPARED_PIXELS) ** 0.5)
        places = places_of(pixels, reduction)
        return cls(
            picture.name, _facts(picture), anomalies(picture), width, height, reduction, places
        )

    def add(self, label: str, pixels: Array, budget: Budget) -> bool:
        """Add a view. Return False if it exceeds the budget.

        Args:
            label: the label of the view.
            pixels: (height, width, 3) uint8, as large as the picture.
            budget: the budget that the view uses.
        """
        if self.reduction > 1:
            image = jpeg_uri(reduce(pixels, self.reduction), REDUCED_QUALITY)
            crops = [jpeg_uri(place.of(pixels)) for place in self.places]
        else:
            image, crops = jpeg_uri(pixels), []
        if not budget.take(image + "".join(crops)):
            return False
        self.views.append({"label": label, "image": image, "crops": crops})
        return True


def places_of(pixels: Array, reduction: int) -> list[Crop]:
    """Return regions of interest of a picture.

    Args:
        pixels: (height, width, 3) uint8.
        reduction: the reduction factor, as in :class:`ComparedImage`. The search uses the reduced
            picture. Regions of reduced pictures are enlarged to CROP px.
    """
    height, width = pixels.shape[:2]
    small = reduce(pixels, reduction)
    if small.shape[1] < WIDTH or small.shape[0] < HEIGHT:
        found = [Crop("middle", 0, 0, small.shape[1], small.shape[0])]
    else:
        found = choose_crops((), small.astype(np.float32) / np.float32(255))
    if reduction == 1:
        return found
    wide, high = min(CROP[0], width), min(CROP[1], height)

    def enlarged(place: Crop) -> Crop:
        left = reduction * (2 * place.left + place.width) // 2 - wide // 2
        top = reduction * (2 * place.top + place.height) // 2 - high // 2
        left, top = min(max(left, 0), width - wide), min(max(top, 0), height - high)
        return replace(place, left=left, top=top, width=wide, height=high)

    return list(map(enlarged, found))


def select_images(run: Run, names: Collection[str]) -> list[RunPicture]:
    """Return the images to compare: given and unusual ones first, then an even sample."""
    pictures = [picture for picture in run.pictures if picture_file(picture)]
    unusual = [picture for picture in pictures if picture.name in names or anomalies(picture)][
        : MAX_COMPARED // 2
    ]
    others = [picture for picture in pictures if picture not in unusual]
    count = min(MAX_COMPARED - len(unusual), len(others))
    return unusual + [others[i * len(others) // count] for i in range(count)]


def compared_image(
    runs: Sequence[Run],
    labels: Sequence[str],
    picture: RunPicture,
    budget: Budget,
    problems: list[str],
) -> ComparedImage | None:
    """Return one image to compare. None if no view of it can be shown.

    Args:
        runs: the run of the image, and a second run that may have the same picture.
        labels: the labels of the runs.
        picture: the picture.
        budget: the budget that views use.
        problems: gets the errors of views.
    """
    shown: ComparedImage | None = None
    comparison = [
        (label, file) for label, file in _comparison_picture(runs[0], picture) if len(runs) == 1
    ]
    views = [
        (" ".join(filter(None, (label, view))), file)
        for label, run in zip(labels, runs, strict=True)
        if (own := run.matching_picture(picture))
        for view, file in _views(run, own)
    ]
    views.sort(key=lambda view: not view[0].endswith(PICTURE))
    for label, file in views if len(views) > 1 else views + comparison:
        try:
            pixels = decode_8_bit(checked(file), file.name)
        except ImageError as error:
            problems.append(str(error))
            continue
        shown = shown or ComparedImage.of(picture, pixels)
        if pixels.shape[:2] != (shown.height, shown.width):
            problems.append(f"{file.name}: its size differs from {picture.name}")
        elif not shown.add(label, pixels, budget):
            return None
    if shown:
        shown.stage_thumbnails = _strip(picture, budget, problems)
    return shown


def _views(run: Run, picture: RunPicture) -> Iterator[tuple[str, Blob]]:
    """Yield the picture, its truths and its baselines, with their labels."""
    if file := picture_file(picture):
        yield PICTURE, file
    for rendition, other in run.of_image(picture.image).items():
        is_shown = (
            rendition.role in (*PICTURES, *BASELINES) and rendition.ev == picture.rendition.ev
        )
        if is_shown and (file := picture_file(other)):
            yield rendition.label.strip("."), file


def _comparison_picture(run: Run, picture: RunPicture) -> Iterator[tuple[str, Blob]]:
    """Yield a picture to compare with one without truths, and its label.

    It is a picture of the same file with another ISO, exposure or frame. Otherwise it is the
    neighbour in a sequence, whose name differs only in digits.
    """
    alike = [
        other
        for other in run.all_pictures
        if other is not picture
        and other.rendition.role == NOISY
        and other.value("sha256") == picture.value("sha256")
        and all(other.value(key) == picture.value(key) for key in ("width", "height"))
    ]
    pictures = run.pictures
    number_of = pictures.index(picture)
    near = pictures[number_of - 1 if number_of else 1 : number_of or 2]
    alike += [each for each in near if _without_digits(each.name) == _without_digits(picture.name)]
    for other in alike[:1]:
        if file := picture_file(other):
            iso = f"{number(other.value('iso')):.0f}"
            yield f"{other.name} ({other.value('camera')}, ISO {iso})", file


def _without_digits(name: str) -> str:
    return re.sub(r"\d+", "", name)


def _kept(picture: RunPicture) -> Iterator[tuple[str, Blob]]:
    """Yield the kept stages of a picture in the order of its chain."""
    for name in (str(step.get("name")) for step in picture.steps):
        if file := picture.files.get(f"{name}.exr") or picture.files.get(f"{name}.npy"):
            yield name, file


def add_stages(shown: ComparedImage, picture: RunPicture, budget: Budget) -> None:
    """Add the kept stages of a picture as views, until the page's budget is used up.

    Stages that differ in size from the picture are skipped. Unreadable files are reported with the
    thumbnails.
    """
    for name, file in _kept(picture):
        try:
            pixels = decode_8_bit(checked(file), file.name)
        except ImageError:
            continue
        is_alike = pixels.shape[:2] == (shown.height, shown.width)
        if is_alike and not shown.add(f"after {name}", pixels, budget):
            return


def _strip(picture: RunPicture, budget: Budget, problems: list[str]) -> list[dict[str, str]]:
    """Return thumbnails of the kept stages of a picture in the order of its chain."""
    stage_thumbnails = []
    for name, file in _kept(picture):
        image, problem = _thumbnail(file, 2 * THUMBNAIL_SIZE)
        problems += [problem] if problem else []
        if image and budget.take(image):
            stage_thumbnails.append({"label": name, "image": image})
    return stage_thumbnails


def _facts(picture: RunPicture) -> str:
    """Return a line of facts about a picture."""
    a, b = (number(picture.value("noise", "signal", key)) for key in "ab")
    law = f", noise variance {a:.3g} y + {b:.3g} (in squared signal, y from 0 to 1)"
    size = f"{number(picture.value('width')):.0f} x {number(picture.value('height')):.0f} px"
    iso, clipped = number(picture.value("iso")), number(picture.value("clipped"))
    lens = f" with {picture.value('lens')}" if picture.value("lens") else ""
    text = f"{size}, {picture.value('camera')}{lens}, ISO {iso:.0f}, {clipped * 100:.2f} % clipped"
    return text + (law if picture.value("noise", "signal") else "")
