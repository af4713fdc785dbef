"""The keys of annotations, and what becomes of each: COCO, BOP and KITTI."""

import logging
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from clpipe.base.vocabulary import TELLING, Vocabulary

log = logging.getLogger(__name__)

# Keys that state a place in the picture, which stages may move, or a camera.
PLACES = re.compile(
    TELLING.pattern + r"|box|poly|contour|outline|cent(?:er|re)|corner|ellipse|mask|segm|landmark"
    r"|coord|pixel|point|_2d|2d_|^uv|_uv|area|size|intrinsic|^k$|cam|focal|^f[xy]$|^c[xy]$|depth",
    re.IGNORECASE,
)
COPIED = "copies"  # unchanged, although stages may move pixels

COCO = Vocabulary.of(
    "COCO",
    "cocodataset.org, Data format; the keys of its pose, panoptic and caption tasks",
    {
        "used": {
            "the pictures": "images file_name width height id image_id",
            "boxes, outlines, masks, warped like the picture": "bbox segmentation area truncated",
            "keypoints, warped like the picture": "keypoints num_keypoints",
            "the objects": "annotations categories",
        },
        "ignored": {
            "copied, because stages do not change it": "category_id iscrowd name supercategory "
            "skeleton isthing color caption ignore occluded visibility score attributes track_id "
            "info licenses license date_captured year version description contributor url",
            "copied: names of the file elsewhere": "coco_url flickr_url",
        },
    },
    PLACES,
    COPIED,
)
BOP = Vocabulary.of(
    "BOP",
    "bop_toolkit, docs/bop_datasets_format.md",
    {
        "used": {
            "the camera, after resizing and distortion": "cam_K",
            "boxes, from the warped masks": "bbox_obj bbox_visib",
            "pixels of masks, from the warped masks": "px_count_all px_count_valid px_count_visib "
            "visib_fract",
        },
        "ignored": {
            "copied, because poses are in the camera's space": "cam_R_m2c cam_t_m2c obj_id "
            "cam_R_w2c cam_t_w2c",
            "copied: the unit of depth, which carried layers keep": "depth_scale",
            "copied: how a scene was rendered": "view_level elev mode cam_model inst_id",
        },
    },
    PLACES,
    COPIED,
)
KITTI = Vocabulary.of(
    "KITTI",
    "the object development kit's readme (cvlibs.net, 2012)",
    {
        "used": {
            "boxes, warped like the picture": "bbox truncated",
            "the cameras, after resizing": "P0 P1 P2 P3",
        },
        "ignored": {
            "copied, because stages do not change it": "type occluded alpha dimensions location "
            "rotation_y score",
            "copied: between the camera, the laser and the car": "R0_rect R_rect Tr_velo_to_cam "
            "Tr_velo_cam Tr_imu_to_velo Tr_imu_velo Tr_cam_to_road",
        },
    },
    PLACES,
    COPIED,
)


def name_unknown(path: Path, vocabulary: Vocabulary, records: Iterable[Mapping[str, Any]]) -> None:
    """Print a warning with the keys that clpipe does not know, and that may state a place.

    Args:
        path: the file, for the message.
        vocabulary: of its format.
        records: with keys of the file.
    """
    keys = {key: None for record in records for key in record}
    for sentence in vocabulary.warnings(keys):
        log.warning("--annotations %s: %s", path, sentence)
