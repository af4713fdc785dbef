"""--annotations: COCO's boxes, outlines, masks and keypoints go where the pixels go."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pycocotools")
pytest.importorskip("shapely")

from pycocotools import mask as coder
from pycocotools.coco import COCO

# pycocotools has not followed NumPy 2 in this.
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

WIDTH, HEIGHT = 160, 120
BARREL = ("--set", "distortion.method=brown_conrady", "--set", "distortion.k1=-0.25")
BARREL += ("--set", "render.fx=110", "--set", "distortion.p1=0.01")
RUN = ("--device", "numpy", "--skip", "noise", "--annotations", "coco.json", "--format", "png")
PLAIN = ("--stages", "distortion,resize,exposure,gamma", "--set", "exposure.headroom=0")
SHAPES = {
    1: [[20, 15], [70, 25], [60, 80], [35, 60], [22, 78]],  # concave
    2: [[100, 20], [170, 30], [150, 70], [105, 62]],  # beyond the edge
    3: [[80, 85], [120, 85], [120, 115], [80, 115]],
}


def mask_of(points, beyond=0):
    """The share of each pixel that an outline covers, by 8x8 places in it."""
    height, width = HEIGHT + 2 * beyond, WIDTH + 2 * beyond
    y, x = (np.mgrid[: height * 8, : width * 8] + 0.5) / 8 - beyond
    inside = np.zeros(x.shape, bool)
    for (ax, ay), (bx, by) in zip(points, points[1:] + points[:1], strict=True):
        crosses = (ay > y) != (by > y)
        at = ax + (y - ay) * (bx - ax) / (by - ay if by != ay else 1)
        inside ^= crosses & (x < at)
    return inside.reshape(height, 8, width, 8).mean((1, 3))


@pytest.fixture
def coco(write_exr):
    """A render of each shape in a channel of its own, and annotations of all kinds."""
    masks = np.stack([mask_of(points) for points in SHAPES.values()], -1).astype(np.float32)
    write_exr("in/a.exr", masks, half=False)
    annotations = [
        {
            **{"id": n, "image_id": 7, "category_id": 1, "iscrowd": 0, "area": 0},
            "segmentation": [np.ravel(points).tolist()],
            "bbox": [*np.min(points, 0).tolist(), *np.ptp(points, 0).tolist()],
            "keypoints": [v for x, y in points for v in (x, y, 2)],
            "num_keypoints": len(points),
        }
        for n, points in SHAPES.items()
    ]
    packed = coder.encode(np.asfortranarray((masks[..., 0] > 0.5).astype(np.uint8)))
    rle = {"size": packed["size"], "counts": packed["counts"].decode()}
    flat = {"image_id": 7, "category_id": 1, "iscrowd": 1, "bbox": [0, 0, 1, 1], "area": 1}
    annotations.append({**flat, "id": 4, "segmentation": rle})
    annotations.append({**flat, "id": 5, "bbox": [80, 85, 40, 30], "iscrowd": 0})
    image = {"id": 7, "file_name": "images/a.jpg", "width": WIDTH, "height": HEIGHT, "license": 3}
    whole = {"images": [image], "annotations": annotations}
    whole["categories"] = [{"id": 1, "name": "thing"}]
    Path("coco.json").write_text(json.dumps(whole))
    return whole


def read_back(folder="o"):
    path = Path(folder) / "annotations.json"
    told = COCO(str(path))
    return told, [told.anns[number] for number in sorted(told.anns)]


def seen(path):
    """What the picture shows of each shape, linear."""
    with Image.open(path) as image:
        codes = np.asarray(image, np.float64) / 255
    return np.where(codes > 0.04045, ((codes + 0.055) / 1.055) ** 2.4, codes / 12.92)


@pytest.mark.parametrize("way", ["as it is", "barrel", "smaller"])
def test_outlines_lie_where_the_picture_has_the_shapes(clpipe, coco, way):
    options = {"barrel": BARREL, "smaller": ("--set", "resize.scale=0.6")}.get(way, ())
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PLAIN, *options)
    told, found = read_back()
    picture = seen("o/a.png")
    height, width = picture.shape[:2]
    (image,) = told.imgs.values()
    assert (image["file_name"], image["width"], image["height"]) == ("a.png", width, height)
    assert image["license"] == 3
    for channel, each in enumerate(found[:3]):
        own = told.annToMask(each).astype(float)
        shown = picture[..., channel]
        perimeter = 2 * sum(each["bbox"][2:])
        # COCO's masks are of whole pixels: half a pixel along the outline, at most.
        assert abs(own - shown).sum() < 0.5 * perimeter
        assert each["area"] == pytest.approx(shown.sum(), rel=0.02)
        rows, columns = np.nonzero(shown > 0.5)
        x, y, w, h = each["bbox"]
        assert abs(np.array([x, y]) - [columns.min(), rows.min()]).max() < 1
        assert abs(np.array([x + w, y + h]) - [columns.max() + 1, rows.max() + 1]).max() < 1
    of_mask = told.annToMask(found[3])
    assert np.mean(of_mask != (picture[..., 0] > 0.5)) < 0.01
    assert found[3]["area"] == of_mask.sum() and found[3]["iscrowd"] == 1
    assert found[0]["truncated"] == 0 and 0.01 < found[1]["truncated"] < 0.3
    # The corners that are in the picture, and no others.
    assert (found[0]["num_keypoints"], found[1]["num_keypoints"]) == (5, 3)
    assert found[1]["keypoints"][3:6] == [0, 0, 0]


def test_what_overscan_shows_is_annotated(clpipe, coco, write_exr):
    masks = np.stack([mask_of(points, 24) for points in SHAPES.values()], -1).astype(np.float32)
    window = {"x": -24, "y": -24, "full_width": WIDTH, "full_height": HEIGHT}
    write_exr("in/a.exr", masks, half=False, **window)
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PLAIN, *BARREL, "--set", "distortion.k1=-0.18")
    told, found = read_back()
    picture = seen("o/a.png")
    assert picture.shape[:2] == (HEIGHT, WIDTH)
    for channel, each in enumerate(found[:3]):
        shown = picture[..., channel]
        assert abs(told.annToMask(each) - shown).sum() < sum(each["bbox"][2:])
        assert each["area"] == pytest.approx(shown.sum(), rel=0.02)
    assert found[1]["truncated"] < 0.02  # what was cut off lies in the picture now
    assert np.mean(told.annToMask(found[3]) != (picture[..., 0] > 0.5)) < 0.01


def test_patches_have_their_own(clpipe, coco):
    patches = ("--patch", 48, "--patches-per-image", 12, "--augment", "--seed", 3)
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PLAIN, *BARREL, *patches)
    told, found = read_back()
    assert len(told.imgs) == 12 and {i["width"] for i in told.imgs.values()} == {48}
    checked = 0
    for each in found:
        picture = seen(Path("o") / told.imgs[each["image_id"]]["file_name"])
        if isinstance(each.get("segmentation"), list):
            shown = max((picture[..., c].sum(), c) for c in range(3))
            overlap = [abs(told.annToMask(each) - picture[..., c]).sum() for c in range(3)]
            assert min(overlap) < 0.6 * 2 * sum(each["bbox"][2:]), shown
            checked += 1
        if isinstance(each.get("segmentation"), dict):
            assert abs(told.annToMask(each) - picture[..., 0]).sum() < 60
    assert checked >= 8
    named = {each["image_id"] for each in found}
    empty = [number for number in told.imgs if number not in named]
    for number in empty:
        assert seen(Path("o") / told.imgs[number]["file_name"]).max() < 0.5


def test_each_series_and_a_resumed_run_have_theirs(clpipe, coco):
    run = ("run", "in", "-o", "o", "--iso", "100,800", *RUN[:2], *RUN[4:])
    clpipe(*run, *BARREL)
    one, other = (Path(f"o/iso{n}/annotations.json").read_bytes() for n in (100, 800))
    assert one == other
    said = clpipe(*run, *BARREL).stderr
    assert "there already" in said and "wrote o/iso800/annotations.json: 5 annotations of 1" in said
    assert Path("o/iso800/annotations.json").read_bytes() == other


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("images"), "has no list 'images'"),
        (lambda c: c["annotations"][0].update(image_id=9), "annotations[0]: found image_id 9"),
        (lambda c: c["annotations"][1].update(bbox=[1, 2]), "annotations[1].bbox: found [1, 2]"),
        (
            lambda c: c["annotations"][0].update(segmentation=[[1, 2]]),
            "found [[1, 2]]",
        ),
        (lambda c: c["images"][0].update(width="a"), "images[0]: found width and height"),
    ],
)
def test_what_is_refused(clpipe, coco, change, message):
    change(coco)
    Path("coco.json").write_text(json.dumps(coco))
    said = clpipe("run", "in", "-o", "o", *RUN, status=2).stderr
    assert message in said and not Path("o").exists()
    Path("coco.json").write_text("no json")
    assert "no valid JSON" in clpipe("run", "in", "-o", "o", *RUN, status=2).stderr


def test_annotations_of_another_size_are_told(clpipe, coco):
    coco["images"][0]["width"] = 100
    Path("coco.json").write_text(json.dumps(coco))
    said = clpipe("run", "in", "-o", "o", *RUN).stderr
    assert "the annotations are of 100x120 pixels" in said
    coco["images"][0]["file_name"] = "b.jpg"
    Path("coco.json").write_text(json.dumps(coco))
    said = clpipe("run", "in", "-o", "o", *RUN).stderr
    assert "1 pictures are of renders that coco.json does not name" in said
