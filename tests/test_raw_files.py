"""Files of real cameras, and of real accidents: each is developed, or refused with its reason."""

import numpy as np
import pytest

from clpipe.base.errors import ImageError
from clpipe.images.dump import parse_dump
from clpipe.images.raw import read_facts
from clpipe.reference.cfa import PATTERNS
from tests.conftest import cli_output as clpipe
from tests.dng import field, write_dng
from tests.test_raw import developed, mosaic

# Files of real cameras, and of real accidents.

MUSHFIQ = ("--set", "normalize.black_level=600", "--set", "normalize.white_level=16383")
REAL = {
    "bep_truncated.cr2": "damaged, or not a raw that LibRaw knows",
    "exiftool_DNG.dng": "holds no pixels",
    "exiftool_Nikon.nef": "damaged, or not a raw that LibRaw knows",
    "infisp_BlackImage_1920x1080_12bits_BGGR.raw": ("--dump", "1920x1080:uint16le"),
    "magicknet_DSC8695.dng": "holds every colour at every pixel",
    "magicknet_RAW_KODAK_DC50.KDC": (),
    "mei_issue247-1.nef": "it is a JPEG, not a camera's raw",
    **{
        f"mushfiq_DSC_1339_768x512_{pattern.lower()}.raw": (
            *("--dump", "768x512:uint16le", *MUSHFIQ, "--set", f"mosaic.pattern={pattern}"),
        )
        for pattern in PATTERNS
    },
    "tinydng_colorchart.dng": (),
}


def test_every_file_is_in_the_table(shared_data):
    assert {path.name for path in (shared_data / "raw").iterdir()} == set(REAL)


@pytest.mark.parametrize(("name", "expected"), REAL.items())
def test_real_files(shared_data, tmp_path, name, expected):
    path = shared_data / "raw" / name
    if isinstance(expected, str):
        assert f"{path}: {expected}" in clpipe("run", path, "-o", tmp_path, status=1)
        return
    if "--dump" in expected:
        assert "a dump of samples" in clpipe("run", path, "-o", tmp_path, status=1)
    clpipe("run", path, "-o", tmp_path, *expected, "--format", "png")
    picture = developed(tmp_path / f"{path.stem}.png")
    size = {"inf": (1080, 1920), "mus": (512, 768), "mag": (512, 768), "tin": (1156, 1734)}
    assert picture.shape == (*size[name[:3]], 3)
    if name[:3] == "inf":
        return  # a dark frame
    assert 0.1 < picture.mean() < 0.7
    blue_to_red = picture[..., 2].mean() / picture[..., 0].mean()
    assert 0.7 < blue_to_red < 1.5


def test_four_phases_of_one_picture(shared_data, tmp_path):
    """The files hold one picture whose samples changed places within each 2x2 cell."""
    pictures, cells = [], []
    for name, options in REAL.items():
        if not name.startswith("mushfiq"):
            continue
        path = shared_data / "raw" / name
        clpipe("run", path, "-o", tmp_path, *options, "--format", "png")
        picture = developed(tmp_path / f"{path.stem}.png")[8:-8, 8:-8]
        pictures.append(picture.reshape(124, 4, 188, 4, 3).mean((1, 3)))
        pattern = name[-8:-4].upper()
        dn = parse_dump("768x512:uint16le").unpack(path.read_bytes())
        samples = dn.reshape(256, 2, 384, 2).transpose(0, 2, 1, 3).reshape(256, 384, 4)
        cells.append(np.stack([samples[..., pattern.index(c)] for c in "RB"], axis=-1))
    for picture, cell in zip(pictures[1:], cells[1:], strict=True):
        assert np.array_equal(cell, cells[0])
        apart = np.abs(picture - pictures[0])
        assert np.median(apart) < 1 / 255 and apart.mean() < 3 / 255
        assert np.abs(picture.mean((0, 1)) - pictures[0].mean((0, 1))).max() < 1 / 255


def test_colours_are_those_that_libraw_makes(shared_data, tmp_path):
    import rawpy

    path = shared_data / "raw" / "tinydng_colorchart.dng"
    clpipe("run", path, "-o", tmp_path, "--until", "color_matrix")
    own = developed(tmp_path / "tinydng_colorchart.exr")
    with rawpy.imread(str(path)) as raw:
        plain = {"gamma": (1, 1), "no_auto_bright": True, "use_camera_wb": True, "output_bps": 16}
        other = raw.postprocess(**plain) / 65535
    patches = {"white": (930, 704), "grey": (930, 812), "red": (810, 920), "green": (825, 812)}
    for name, (y, x) in patches.items():
        one, two = (i[y - 20 : y + 20, x - 20 : x + 20].mean((0, 1)) for i in (own, other))
        assert one / one.sum() == pytest.approx(two / two.sum(), abs=0.01), name


def test_a_raw_that_says_too_little_is_refused_by_the_library_too(shared_data):
    with pytest.raises(ImageError, match="names no camera, ISO or exposure"):
        read_facts(shared_data / "raw" / "infisp_BlackImage_1920x1080_12bits_BGGR.raw")


def test_a_date_that_cannot_be_stops_nobody(tmp_path):
    """Year 20224: a digit too many."""
    path = tmp_path / "a.dng"
    write_dng(path, mosaic(), changes=[field(306, 2, b"20224:5:06 07:08:09")])
    clpipe("run", path, "-o", tmp_path / "out")
    assert (tmp_path / "out" / "a.jpg").is_file()
