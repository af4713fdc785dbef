"""Each statement of a format's specification has a disposition, and unknown ones are named."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image, TiffImagePlugin, TiffTags

from clpipe.base.errors import ImageError
from clpipe.images.openimageio import open_image
from clpipe.images.raw import check_raw
from clpipe.images.read import read_image
from clpipe.images.statements import read_statements
from clpipe.images.vocabularies import (
    DNG,
    DNG_TAGS,
    JPEG,
    OPENEXR,
    PNG,
    TIFF,
    dng_warnings,
    raw_compression,
)
from clpipe.inputs.annotation_keys import BOP, COCO, KITTI
from clpipe.inputs.bop import read_bop
from clpipe.inputs.coco import read_coco
from clpipe.inputs.kitti import read_kitti
from tools.pages.docs_hook import VOCABULARIES, statements_page

# The standard attributes of openexr.com (3.4), without those of the layout that all files have.
STANDARD_ATTRIBUTES = """displayWindow dataWindow originalDataWindow pixelAspectRatio
screenWindowCenter screenWindowWidth lineOrder compression channels name type version chunkCount
tiles worldToCamera worldToNDC sensorCenterOffset sensorOverallDimensions sensorPhotositePitch
sensorAcquisitionRectangle xDensity longitude latitude altitude cameraMake cameraModel
cameraSerialNumber cameraFirmwareVersion cameraUuid cameraLabel cameraCCTSetting cameraTintSetting
cameraColorBalance isoSpeed expTime shutterAngle captureRate lensMake lensModel lensSerialNumber
lensFirmwareVersion nominalFocalLength pinholeFocalLength effectiveFocalLength entrancePupilOffset
aperture tStop focus owner comments capDate utcOffset keyCode framesPerSecond timeCode imageCounter
reelName ascFramingDecisionList chromaticities whiteLuminance adoptedNeutral envmap wrapmodes
multiView deepImageState idManifest colorInteropID dwaCompressionLevel renderingTransform
lookModTransform maxSamplesPerPixel"""
# PNG Specification, third edition, table 7.
CHUNKS = """IHDR PLTE IDAT IEND acTL cHRM cICP gAMA iCCP mDCV cLLI sBIT sRGB bKGD hIST tRNS eXIf
fcTL pHYs sPLT fdAT tIME iTXt tEXt zTXt"""
# The object format of COCO's annotation files, with keypoints and captions.
COCO_KEYS = """info images annotations categories licenses id width height file_name license
flickr_url coco_url date_captured image_id category_id segmentation area bbox iscrowd keypoints
num_keypoints caption name supercategory skeleton"""
# bop_datasets_format.md
BOP_KEYS = """cam_K depth_scale cam_R_w2c cam_t_w2c view_level cam_R_m2c cam_t_m2c obj_id bbox_obj
bbox_visib px_count_all px_count_valid px_count_visib visib_fract"""
# The columns of a label and the lines of a calibration.
KITTI_KEYS = """type truncated occluded alpha bbox dimensions location rotation_y score P0 P1 P2 P3
R0_rect Tr_velo_to_cam Tr_imu_to_velo"""


@pytest.mark.parametrize(
    ("vocabulary", "names"),
    [
        (OPENEXR, STANDARD_ATTRIBUTES.split()),
        (PNG, CHUNKS.split()),
        (TIFF, [TiffTags.lookup(tag).name for tag in TiffTags.TAGS_V2 if 254 <= tag <= 532]),
        (DNG, DNG_TAGS.values()),
        (JPEG, ["JFIF", "Exif", "ICC_PROFILE", "Adobe"]),
        (COCO, COCO_KEYS.split()),
        (BOP, BOP_KEYS.split()),
        (KITTI, KITTI_KEYS.split()),
    ],
)
def test_each_published_statement_has_a_disposition(vocabulary, names):
    assert [name for name in names if name not in vocabulary.statements] == []


@pytest.mark.parametrize("vocabulary", VOCABULARIES, ids=lambda each: each.format)
def test_unknown_names_of_colours_lenses_and_time_are_named_and_others_are_not(vocabulary):
    for telling in ("vendor/colorSpace", "lens_distortion", "WhiteBalance", "rolling_shutter"):
        [sentence] = vocabulary.warnings([telling])
        assert telling in sentence
    assert vocabulary.warnings(["Software", "vendor/renderTime", "Frame", "sampleCount"]) == []


@pytest.mark.parametrize("vocabulary", VOCABULARIES, ids=lambda each: each.format)
def test_the_page_has_each_statement(vocabulary):
    page = statements_page()
    for statement in vocabulary.statements.values():
        assert f"`{statement.name}`" in page and statement.meaning in page


def warnings_of_exr(path, **attributes):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    with OpenEXR.File(header, {"RGB": np.full((8, 8, 3), 0.5, np.float32)}) as file:
        file.write(str(path))
    return read_image(path, False).warnings


def test_attributes_of_openexr(tmp_path):
    usual = {"expTime": 0.5, "aperture": 4.0, "owner": "me", "cameraCCTSetting": 5600.0}
    usual |= {"File": "a.blend", "cycles.ViewLayer.samples": "64", "RenderTime": "00:01"}
    assert warnings_of_exr(tmp_path / "a.exr", **usual) == ()
    look = warnings_of_exr(tmp_path / "b.exr", lookModTransform="warm")
    assert look == ("its lookModTransform (the intended look) is not used",)
    odd = {"vendor/lensDistortion": "0.1 0 0", "ocio_colorspace": "acescg"}
    assert warnings_of_exr(tmp_path / "c.exr", **odd) == (
        "clpipe does not know its ocio_colorspace, vendor/lensDistortion, and does not use them",
    )


def statements(path):
    with open_image(path) as file:
        return read_statements(path, file).warnings


def chunk(name, content):
    check = zlib.crc32(name + content)
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", check)


def test_pictures_in_integers(tmp_path):
    picture = Image.fromarray(np.full((8, 8, 3), 128, np.uint8))
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[319] = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
    picture.save(tmp_path / "a.tif", tiffinfo=tags)
    assert statements(tmp_path / "a.tif") == (
        "its PrimaryChromaticities (the primaries of its colours) is not used",
    )
    for number, expected in ((1, 0), (2, 1), (65535, 1)):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA001] = number
        picture.save(tmp_path / "a.jpg", exif=exif)
        found = statements(tmp_path / "a.jpg")
        assert len(found) == expected and all("Exif:ColorSpace" in each for each in found)
    picture.save(tmp_path / "a.png")
    plain = (tmp_path / "a.png").read_bytes()
    assert statements(tmp_path / "a.png") == ()
    after_header = 33
    changed = plain[:after_header] + chunk(b"mDCV", bytes(24)) + plain[after_header:]
    (tmp_path / "a.png").write_bytes(changed)
    assert statements(tmp_path / "a.png") == ("its mDCV (luminance of the display) is not used",)


def dng_with(path, *entries):
    """Write the directory of a DNG with more entries, (tag, TIFF type, values)."""
    directory = TiffImagePlugin.ImageFileDirectory_v2()
    directory[50706] = b"\1\6\0\0"
    directory.tagtype[50706] = 1
    for tag, type_, values in entries:
        directory.tagtype[tag] = type_
        directory[tag] = values
    data = directory.tobytes(8)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + data)
    return path


def test_tags_of_a_dng(tmp_path):
    path = tmp_path / "a.dng"
    assert dng_warnings(dng_with(path)) == []
    assert dng_warnings(dng_with(path, (50730, 10, 0.0), (50718, 5, (1.0, 1.0)))) == []
    [sentence] = dng_warnings(dng_with(path, (51009, 7, bytes(range(8)))))
    assert sentence.startswith("its OpcodeList2 (corrections of defects, shading")
    [sentence] = dng_warnings(dng_with(path, (50730, 10, 1.5)))
    assert sentence == "its BaselineExposure (brightness, in EV) is not used"
    path.write_bytes(b"II*\0\xff\xff\xff\x7f")
    assert dng_warnings(path) == [] and raw_compression(path) == ""


def test_a_compression_that_libraw_lacks_is_named(tmp_path):
    path = dng_with(tmp_path / "a.dng", (259, 3, 52546), (256, 4, 64), (257, 4, 64))
    with pytest.raises(ImageError, match=r"its compression, JPEG XL \(number 52546\), is not"):
        check_raw(path)


def test_unknown_places_in_annotations_are_named(tmp_path, caplog):
    box = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 1, 4, 4], "rotated_box": [1] * 5}
    image = {"id": 1, "file_name": "a.exr", "width": 8, "height": 8, "note": "x"}
    read_coco(Path("a.json"), {"images": [image], "annotations": [box], "categories": []})
    expected = "clpipe does not know its rotated_box, and copies it"
    assert caplog.messages == [f"--annotations a.json: {expected}"]
    caplog.clear()
    (tmp_path / "scene_gt.json").write_text(json.dumps({"1": [{"obj_id": 1, "center_2d": [4, 4]}]}))
    read_bop(tmp_path / "scene_gt.json")
    assert "its center_2d, and copies it" in caplog.text
    caplog.clear()
    (tmp_path / "label_2").mkdir()
    (tmp_path / "calib").mkdir()
    (tmp_path / "label_2" / "a.txt").write_text("Car 0 0 0 1 1 4 4 1 1 1 0 0 9 0\n")
    (tmp_path / "calib" / "a.txt").write_text(f"P2: {' '.join(['1'] * 12)}\nD_02: 0.1 0 0 0 0\n")
    read_kitti(tmp_path / "label_2")
    assert caplog.text == ""
    (tmp_path / "calib" / "a.txt").write_text("S_rect_02: 1 1\ndistortion_02: 0.1 0\n")
    read_kitti(tmp_path / "label_2")
    assert "its distortion_02, and copies it" in caplog.text
