"""Colour spaces that OpenEXR files name: converted, decoded, rejected, never dropped."""

import numpy as np
import OpenEXR
import pytest

from clpipe.base.errors import ImageError
from clpipe.images.colour_names import ALIASES, PRIMARIES, colour_space
from clpipe.images.read import read_image

PIXELS = np.random.default_rng(0).uniform(0.05, 0.8, (12, 16, 3)).astype(np.float32)
# Names of the Color Interop Forum's recommendation for textures and rendering.
FORUM = (
    *("lin_ap1_scene", "lin_ap0_scene", "lin_rec709_scene", "lin_p3d65_scene"),
    *("lin_rec2020_scene", "lin_adobergb_scene", "lin_ciexyzd65_scene", "srgb_rec709_scene"),
    *("srgb_ap1_scene", "srgb_p3d65_scene", "g22_rec709_scene", "g18_rec709_scene"),
    *("g22_adobergb_scene", "g22_ap1_scene", "data"),
)


def written(path, pixels=PIXELS, **attributes):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, **attributes}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels)}).write(str(path))
    return read_image(path)


@pytest.mark.parametrize("name", FORUM)
def test_every_name_of_the_forum_is_known(name):
    assert colour_space(name) is not None


def test_every_alias_leads_to_a_known_name():
    assert all(colour_space(name) and colour_space(other) for name, other in ALIASES.items())


@pytest.mark.parametrize("space", ["ap0", "ap1", "rec2020", "p3d65", "adobergb"])
def test_a_name_converts_like_its_chromaticities(tmp_path, space):
    named = written(tmp_path / "named.exr", colorInteropID=f"lin_{space}_scene")
    stated = written(tmp_path / "stated.exr", chromaticities=PRIMARIES[space])
    assert named.pixels == pytest.approx(stated.pixels, abs=1e-6)
    assert not np.allclose(named.pixels, PIXELS, atol=0.01)
    assert "converted to linear sRGB" in named.warnings[0]


@pytest.mark.parametrize(
    "attributes",
    [{"oiio:ColorSpace": "ACEScg"}, {"colorInteropID": "lin_ap1_scene"}],
)
def test_other_attributes_name_the_same_space(tmp_path, attributes):
    one = written(tmp_path / "a.exr", **attributes)
    two = written(tmp_path / "b.exr", chromaticities=PRIMARIES["ap1"])
    assert one.pixels == pytest.approx(two.pixels, abs=1e-6)


def test_an_aces_container_has_aces_colours(tmp_path):
    one = written(tmp_path / "a.exr", acesImageContainerFlag=1)
    two = written(tmp_path / "b.exr", chromaticities=PRIMARIES["ap0"])
    assert one.pixels == pytest.approx(two.pixels, abs=1e-6)


def test_srgb_and_unknown_files_do_not_change(tmp_path):
    for name in ("lin_rec709_scene", "unknown", "scene_linear"):
        plain = written(tmp_path / "a.exr", colorInteropID=name)
        assert np.array_equal(plain.pixels, PIXELS) and not plain.warnings


@pytest.mark.parametrize(("encoding", "power"), [("g22", 2.2), ("g18", 1.8), ("g24", 2.4)])
def test_encoded_samples_are_decoded(tmp_path, encoding, power):
    name = f"{encoding}_rec709_scene"
    encoded = PIXELS ** np.float32(1 / power)
    found = written(tmp_path / "a.exr", encoded, colorInteropID=name)
    assert found.pixels == pytest.approx(PIXELS, abs=1e-6)
    assert found.warnings == (f"its samples, encoded as {name}, were decoded",)


def test_srgb_is_decoded_before_its_primaries_are_converted(tmp_path):
    curved = np.where(PIXELS <= 0.0031308, 12.92 * PIXELS, 1.055 * PIXELS ** (1 / 2.4) - 0.055)
    one = written(tmp_path / "a.exr", np.float32(curved), colorInteropID="srgb_ap1_scene")
    two = written(tmp_path / "b.exr", colorInteropID="lin_ap1_scene")
    assert one.pixels == pytest.approx(two.pixels, abs=1e-5)
    assert len(one.warnings) == 2


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"colorInteropID": "data"}, "its colour space is data, so it is no picture"),
        ({"colorInteropID": "pq_rec2020_display"}, "pq_rec2020_display is encoded for a display"),
        (
            {"colorInteropID": "lin_ap1_scene", "chromaticities": PRIMARIES["rec2020"]},
            "lin_ap1_scene and its chromaticities 0.708.* contradict each other",
        ),
        (
            {"colorInteropID": "lin_rec2020_scene", "acesImageContainerFlag": 1},
            "acesImageContainerFlag lin_ap0_scene contradict each other",
        ),
    ],
)
def test_what_cannot_be_a_picture_is_rejected(tmp_path, attributes, message):
    with pytest.raises(ImageError, match=f"a.exr: .*{message}"):
        written(tmp_path / "a.exr", **attributes)


def test_an_unknown_name_is_named(tmp_path):
    found = written(tmp_path / "a.exr", colorInteropID="lin_mycamera_scene")
    assert np.array_equal(found.pixels, PIXELS)
    assert "its colour space lin_mycamera_scene (colorInteropID) is unknown" in found.warnings[0]
