"""--annotations: COCO, KITTI and BOP annotations are warped with the pixels."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pycocotools", reason="needs pycocotools, in the extra annotations")
pytest.importorskip("shapely", reason="needs Shapely, in the extra annotations")

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
    """Return the share of each pixel inside an outline, by 8x8 samples per pixel."""
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
    """A render with a channel for each shape, and annotations of all kinds."""
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
    coco = COCO(str(path))
    return coco, [coco.anns[number] for number in sorted(coco.anns)]


def seen(path):
    """Return the linear picture of each shape."""
    with Image.open(path) as image:
        codes = np.asarray(image, np.float64) / 255
    return np.where(codes > 0.04045, ((codes + 0.055) / 1.055) ** 2.4, codes / 12.92)


@pytest.mark.parametrize("way", ["as it is", "barrel", "smaller"])
def test_outlines_lie_where_the_picture_has_the_shapes(clpipe, coco, way):
    options = {"barrel": BARREL, "smaller": ("--set", "resize.scale=0.6")}.get(way, ())
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PLAIN, *options)
    coco, found = read_back()
    picture = seen("o/a.png")
    height, width = picture.shape[:2]
    (image,) = coco.imgs.values()
    assert (image["file_name"], image["width"], image["height"]) == ("a.png", width, height)
    assert image["license"] == 3
    for channel, each in enumerate(found[:3]):
        own = coco.annToMask(each).astype(float)
        shown = picture[..., channel]
        perimeter = 2 * sum(each["bbox"][2:])
        # COCO's masks are of whole pixels: half a pixel along the outline, at most.
        assert abs(own - shown).sum() < 0.5 * perimeter
        assert each["area"] == pytest.approx(shown.sum(), rel=0.02)
        rows, columns = np.nonzero(shown > 0.5)
        x, y, w, h = each["bbox"]
        assert abs(np.array([x, y]) - [columns.min(), rows.min()]).max() < 1
        assert abs(np.array([x + w, y + h]) - [columns.max() + 1, rows.max() + 1]).max() < 1
    of_mask = coco.annToMask(found[3])
    assert np.mean(of_mask != (picture[..., 0] > 0.5)) < 0.01
    assert found[3]["area"] == of_mask.sum() and found[3]["iscrowd"] == 1
    assert found[0]["truncated"] == 0 and 0.01 < found[1]["truncated"] < 0.3
    # The corners that are in the picture, and no others.
    assert (found[0]["num_keypoints"], found[1]["num_keypoints"]) == (5, 3)
    assert found[1]["keypoints"][3:6] == [0, 0, 0]


@pytest.mark.slow
def test_what_overscan_shows_is_annotated(clpipe, coco, write_exr):
    masks = np.stack([mask_of(points, 24) for points in SHAPES.values()], -1).astype(np.float32)
    window = {"x": -24, "y": -24, "full_width": WIDTH, "full_height": HEIGHT}
    write_exr("in/a.exr", masks, half=False, **window)
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PLAIN, *BARREL, "--set", "distortion.k1=-0.18")
    coco, found = read_back()
    picture = seen("o/a.png")
    assert picture.shape[:2] == (HEIGHT, WIDTH)
    for channel, each in enumerate(found[:3]):
        shown = picture[..., channel]
        assert abs(coco.annToMask(each) - shown).sum() < sum(each["bbox"][2:])
        assert each["area"] == pytest.approx(shown.sum(), rel=0.02)
    assert found[1]["truncated"] < 0.02  # what was cut off lies in the picture now
    assert np.mean(coco.annToMask(found[3]) != (picture[..., 0] > 0.5)) < 0.01


@pytest.mark.slow
def test_patches_have_their_own(clpipe, coco):
    patches = ("--patch", 48, "--patches-per-image", 12, "--augment", "--seed", 3)
    clpipe("run", "in/a.exr", "-o", "o", *RUN, *PLAIN, *BARREL, *patches)
    coco, found = read_back()
    assert len(coco.imgs) == 12 and {i["width"] for i in coco.imgs.values()} == {48}
    checked = 0
    for each in found:
        picture = seen(Path("o") / coco.imgs[each["image_id"]]["file_name"])
        if isinstance(each.get("segmentation"), list):
            shown = max((picture[..., c].sum(), c) for c in range(3))
            overlap = [abs(coco.annToMask(each) - picture[..., c]).sum() for c in range(3)]
            assert min(overlap) < 0.6 * 2 * sum(each["bbox"][2:]), shown
            checked += 1
        if isinstance(each.get("segmentation"), dict):
            assert abs(coco.annToMask(each) - picture[..., 0]).sum() < 60
    assert checked >= 8
    named = {each["image_id"] for each in found}
    empty = [number for number in coco.imgs if number not in named]
    for number in empty:
        assert seen(Path("o") / coco.imgs[number]["file_name"]).max() < 0.5


def test_patches_of_a_burst_are_named_as_their_files(clpipe, coco):
    patches = ("--frames", 2, "--patch", 48, "--patches-per-image", 2)
    clpipe("run", "in/a.exr", "-o", "o", *RUN[:2], *RUN[4:-1], "png16", *patches)
    names = {each["file_name"] for each in read_back()[0].imgs.values()}
    assert names == {path.name for path in Path("o").glob("*.frame?.png")} and len(names) == 4


@pytest.mark.slow
def test_each_series_and_a_resumed_run_have_theirs(clpipe, coco):
    run = ("run", "in", "-o", "o", "--iso", "100,800", *RUN[:2], *RUN[4:])
    clpipe(*run, *BARREL)
    one, other = (Path(f"o/iso{n}/annotations.json").read_bytes() for n in (100, 800))
    assert one == other
    stderr = clpipe(*run, *BARREL).stderr
    assert (
        "there already" in stderr
        and "wrote o/iso800/annotations.json: 5 annotations of 1" in stderr
    )
    assert Path("o/iso800/annotations.json").read_bytes() == other


def box_of(points):
    return [*np.min(points, 0).tolist(), *np.max(points, 0).tolist()]


K = [110.0, 0.0, 79.5, 0.0, 110.0, 59.5, 0.0, 0.0, 1.0]


@pytest.fixture
def kitti(coco):
    """The same shapes as KITTI's labels, and a calibration."""
    matrix = [*K[:3], 10.0, *K[3:6], 0.5, *K[6:], 0.01]
    numbers = " ".join(map(str, matrix))
    calibration = "".join(f"P{n}: {numbers}\n" for n in range(4)) + "R0_rect: 1 0 0 0 1 0 0 0 1\n"
    lines = []
    for number, points in SHAPES.items():
        box = " ".join(f"{v - 0.5:.2f}" for v in box_of(points))
        lines.append(f"Car {0.25 if number == 2 else 0} 0 -1.5 {box} 1.5 1.6 4 1 1.5 {number} 0.1")
    lines.append("DontCare -1 -1 -10 150 100 158 110 -1 -1 -1 -1000 -1000 -1000 -10")
    for name, text in (("label_2", "\n".join(lines)), ("calib", calibration)):
        folder = Path("kitti", name)
        folder.mkdir(parents=True)
        (folder / "a.txt").write_text(text)
    return lines


def labels(path):
    return [line.split() for line in Path(path).read_text().splitlines()]


AS_KITTI = ("--device", "numpy", "--skip", "noise", "--format", "png")
AS_KITTI += ("--annotations", "kitti/label_2")


def test_kittis_labels_and_calibration(clpipe, kitti):
    smaller = ("--set", "resize.scale=0.5")
    stderr = clpipe("run", "in/a.exr", "-o", "o", *AS_KITTI, *PLAIN, *smaller).stderr
    assert "wrote o/label_2, o/calib: 4 annotations of 1 pictures" in stderr
    for line, now in zip(kitti, labels("o/label_2/a.txt"), strict=True):
        before = line.split()
        box = (np.array(before[4:8], float) + 0.5) / 2 - 0.5
        clipped = np.clip(box, -0.5, [79.5, 59.5, 79.5, 59.5])
        # KITTI's places are pixels' centres.
        kept = np.clip(clipped, 0, [79, 59, 79, 59])
        assert np.array(now[4:8], float) == pytest.approx(kept, abs=0.011)
        assert now[8:] == before[8:] and now[0] == before[0] and now[2:4] == before[2:4]
        shown = np.prod(clipped[2:] - clipped[:2]) / np.prod(box[2:] - box[:2])
        cut = float(before[1])
        assert float(now[1]) == pytest.approx(cut if cut < 0 else 1 - (1 - cut) * shown, abs=0.006)
    matrices = {words[0]: np.array(words[1:], float) for words in labels("o/calib/a.txt")}
    p2 = matrices["P2:"].reshape(3, 4)
    # A place in space is seen half as far from the corner.
    place = np.array([1, 2, 5, 1.0])
    was = np.array([*K[:3], 10, *K[3:6], 0.5, *K[6:], 0.01]).reshape(3, 4) @ place
    now = p2 @ place
    assert now[:2] / now[2] + 0.5 == pytest.approx((was[:2] / was[2] + 0.5) / 2)
    assert matrices["R0_rect:"].tolist() == [1, 0, 0, 0, 1, 0, 0, 0, 1]


def test_kittis_boxes_go_through_a_lens_and_into_patches(clpipe, kitti):
    clpipe("run", "in/a.exr", "-o", "o", *AS_KITTI, *PLAIN, *BARREL, "--set", "distortion.p1=0")
    picture, found = seen("o/a.png"), labels("o/label_2/a.txt")
    for channel, words in enumerate(found[:3]):
        rows, columns = np.nonzero(picture[..., channel] > 0.5)
        left, top, right, bottom = (float(v) + 0.5 for v in words[4:8])
        # The box of a bent box has the shape in it, and not much more.
        assert left < columns.min() + 0.6 and top < rows.min() + 0.6
        assert right > min(columns.max(), WIDTH - 1) + 0.4
        assert bottom > min(rows.max(), HEIGHT - 1) + 0.4
        assert (right - left) * (bottom - top) < 1.35 * np.ptp(columns) * np.ptp(rows)
    patches = ("--patch", 48, "--patches-per-image", "grid")
    clpipe("run", "in/a.exr", "-o", "p", *AS_KITTI, *PLAIN, *patches)
    boxes = [
        np.array(words[4:8], float) + 0.5
        for path in sorted(Path("p/label_2").glob("*.txt"))
        for words in labels(path)
        if words[0] == "Car"
    ]
    assert len(boxes) > 4
    assert all((box >= 0).all() and (box <= 48).all() for box in boxes)
    stderr = clpipe("run", "in/a.exr", "-o", "q", *AS_KITTI, *PLAIN, *patches, "--augment").stderr
    assert "flipped and rotated patches have no poses" in stderr


AS_BOP = ("--device", "numpy", "--skip", "noise", "--format", "png")
AS_BOP += ("--annotations", "bop/scene_gt.json", *PLAIN, *BARREL, "--set", "resize.scale=0.5")


@pytest.fixture
def bop(write_exr):
    """A scene of three objects, the last outside the picture: files by name, and masks."""
    masks = np.stack([mask_of(points) for points in SHAPES.values()], -1).astype(np.float32)
    write_exr("in/000003.exr", masks, half=False)
    visible = masks[..., 0] * (np.arange(WIDTH) < 50)
    folder = Path("bop")
    for kind in ("mask", "mask_visib"):
        (folder / kind).mkdir(parents=True)
    nothing = np.zeros_like(visible)
    of_kind = {"mask": [masks[..., 0], masks[..., 2], nothing]}
    of_kind["mask_visib"] = [visible, nothing, nothing]
    for kind, of_objects in of_kind.items():
        for number, mask in enumerate(of_objects):
            whole = np.where(mask > 0.5, 255, 0).astype(np.uint8)
            Image.fromarray(whole).save(folder / kind / f"000003_00000{number}.png")
    pose = {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 1], "obj_id": 5}
    count = int((masks[..., 0] > 0.5).sum())
    info = {"bbox_obj": [0, 0, 1, 1], "bbox_visib": [0, 0, 1, 1], "px_count_all": count}
    info |= {"px_count_valid": count, "px_count_visib": 1, "visib_fract": 0.5}
    second = {**info, "bbox_obj": [80, 85, 40, 30], "bbox_visib": [-1, -1, -1, -1]}
    gone = {**info, "bbox_obj": [300, 300, 5, 5], "bbox_visib": [-1, -1, -1, -1]}
    write = {"scene_gt": [pose] * 3, "scene_gt_info": [info, second, gone]}
    write["scene_camera"] = {"cam_K": K, "depth_scale": 0.1}
    for name, values in write.items():
        (folder / f"{name}.json").write_text(json.dumps({"3": values}))
    return write, of_kind


def test_bops_scene(clpipe, coco, bop):
    write, _ = bop
    stderr = clpipe("run", "in/000003.exr", "-o", "o", *AS_BOP).stderr
    assert "2 annotations of 1 pictures" in stderr
    read = {name: json.loads(Path(f"o/{name}.json").read_text())["3"] for name in write}
    assert read["scene_gt"] == write["scene_gt"][:2]
    shown = seen("o/000003.png")[..., 0] > 0.5
    with Image.open("o/mask/000003_000000.png") as image:
        mask = np.asarray(image) > 0
    assert np.mean(mask != shown) < 0.012
    first, other = read["scene_gt_info"]
    rows, columns = np.nonzero(mask)
    size = np.ptp(columns) + 1, np.ptp(rows) + 1
    assert first["bbox_obj"] == [columns.min(), rows.min(), *size]
    assert first["px_count_all"] == pytest.approx(mask.sum(), abs=1)
    with Image.open("o/mask_visib/000003_000000.png") as image:
        assert first["px_count_visib"] == (np.asarray(image) > 0).sum()
    assert first["visib_fract"] == first["px_count_visib"] / first["px_count_all"]
    assert other["bbox_visib"] == [-1, -1, -1, -1]
    camera = read["scene_camera"]
    assert camera["file_name"] == "000003.png" and camera["depth_scale"] == 0.1
    assert camera["cam_K"][2] == pytest.approx(80 / 2 - 0.5)
    assert camera["cam_K"][0] == pytest.approx(55)
    assert camera["model"] == "OPENCV" and camera["distortion"]["k1"] == -0.25


@pytest.mark.slow
def test_bops_masks_are_of_all_or_of_none(clpipe, coco, bop):
    clpipe("run", "in/000003.exr", "-o", "o", *AS_BOP)
    with_mask = json.loads(Path("o/scene_gt_info.json").read_text())["3"][1]
    Path("bop/mask/000003_000001.png").unlink()
    stderr = clpipe("run", "in/000003.exr", "-o", "p", *AS_BOP, status=2).stderr
    assert "3[1]: found no bop/mask/000003_000001.png; expected masks for all objects" in stderr
    for kind in bop[1]:
        shutil.rmtree(Path("bop", kind))
    clpipe("run", "in/000003.exr", "-o", "p", *AS_BOP)
    boxes = [each["bbox_obj"] for each in json.loads(Path("p/scene_gt_info.json").read_text())["3"]]
    assert min(np.abs(np.subtract(box, with_mask["bbox_obj"])).max() for box in boxes) <= 1.5
    assert not Path("p/mask").exists()


def test_annotations_of_another_size_are_told(clpipe, coco):
    coco["images"][0]["width"] = 100
    del coco["annotations"][3]  # a mask, which is refused
    Path("coco.json").write_text(json.dumps(coco))
    stderr = clpipe("run", "in", "-o", "o", *RUN).stderr
    assert "the annotations state a render of 100x120 pixels" in stderr
    coco["images"][0]["file_name"] = "b.jpg"
    Path("coco.json").write_text(json.dumps(coco))
    stderr = clpipe("run", "in", "-o", "o", *RUN).stderr
    assert "1 picture is not annotated, because coco.json does not list" in stderr


def first(coco, **values):
    coco["annotations"][0] |= values


def mask_with(counts, size=(HEIGHT, WIDTH)):
    return lambda coco: first(coco, segmentation={"size": list(size), "counts": counts})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda coco: coco.pop("images"), "the list 'images' is missing"),
        (lambda coco: first(coco, image_id=9), "annotations[0]: found image_id 9"),
        (lambda coco: first(coco, bbox=[1, 2]), "annotations[0].bbox: found [1, 2]"),
        (lambda coco: first(coco, segmentation=[[1, 2]]), "found [[1, 2]]"),
        (lambda coco: coco["images"][0].update(width="a"), "images[0]: found width and height"),
        (mask_with([-5, HEIGHT * WIDTH + 5]), "annotations[0].segmentation.counts"),
        (mask_with([5, 5]), "found runs of 10 pixels; expected 19200 in all"),
        (mask_with("zzzz"), "found zzzz; expected run lengths"),
        (mask_with("08Q"), "they are incomplete"),
        (mask_with([HEIGHT * WIDTH], (HEIGHT, 7)), "found [120, 7]; expected [120, 160]"),
        (lambda coco: first(coco, segmentation=[[0, 0, 1e12, 0, 9, 9]]), "polygons of three"),
        (lambda coco: first(coco, bbox=[0, 0, float("1e300"), 1]), "x, y, width and height"),
        (
            lambda coco: coco["images"].append({**coco["images"][0], "id": 8}),
            "found the file_name images/a.jpg of an earlier image",
        ),
        (lambda coco: coco["images"][0].update(id=[7]), "images[0].id: found [7]; expected the id"),
        (lambda coco: coco["images"][0].pop("id"), "images[0].id: found None; expected the id"),
        (
            lambda coco: first(coco, image_id={"a": 7}),
            "annotations[0].image_id: found {'a': 7}; expected the id of an image, a number or a",
        ),
        (
            lambda coco: coco["images"][0].update(width=10**4000, height=10**4000),
            "expected whole px from 1 to 100000",
        ),
        (
            mask_with([10**4299] * 20),
            "expected run lengths (each count must be a whole number from 0",
        ),
    ],
)
def test_coco_files_that_are_none(clpipe, coco, damage, message):
    damage(coco)
    Path("coco.json").write_text(json.dumps(coco))
    stderr = clpipe("run", "in", "-o", "o", *RUN, status=2).stderr
    assert message in stderr
    assert not Path("o").exists()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("label_2/a.txt", "Car 0 0", "line 1"),
        ("label_2/a.txt", "Car 0 0 0 9 9 1 1 1 1 1 1 1 1 1", "a box with left <= right"),
        ("label_2/readme.md", "", "has no labels"),
        ("coco.json", "no json", "this is not valid JSON"),
        ("label_2/a.txt", "Car 0 0 0 a b c d 1 1 1 1 1 1 1", "a type and 14 numbers"),
        ("label_2/a.txt", "Car 0 0 0 1e9 1e9 2e9 2e9 1 1 1 1 1 1 1", "a box with left <= right"),
        ("label_2/a.txt", "Car 0 0 0 1 1 nan 3 1 1 1 1 1 1 1", "a type and 14 numbers"),
        ("scene_gt.json", '{"3": 5}', "found 5; expected a list of objects"),
        ("scene_gt.json", '{"3": []}', "3.cam_K: found [1, 2]; expected nine numbers"),
        ("scene_gt.json", f'{{"{"9" * 4400}": []}}', "999; expected a number from 0 to 999999"),
        ("scene_gt.json", f'{{"{"9" * 300}": [{{}}]}}', "999; expected a number from 0 to 999999"),
        ("scene_gt.json", '{"4": [{}]}', "4[0].px_count_all: found 1000000000000000000000000000"),
    ],
)
def test_files_that_are_of_no_format(clpipe, write_exr, name, text, message):
    write_exr("in/a.exr", np.zeros((8, 9, 3), np.float32))
    path = Path("of", name)
    path.parent.mkdir(parents=True)
    path.write_text(text)
    path.with_name("scene_camera.json").write_text('{"3": {"cam_K": [1, 2]}}')
    path.with_name("scene_gt_info.json").write_text(f'{{"4": [{{"px_count_all": {10**400}}}]}}')
    target = path if path.suffix == ".json" else path.parent
    stderr = clpipe("run", "in", "-o", "o", "--annotations", target, status=2).stderr
    assert message in stderr
    assert not Path("o").exists()
