"""Raw files of real cameras, also damaged: each is developed, or rejected with its reason."""

import numpy as np
import pytest
import rawpy

from clpipe.base.errors import ImageError
from clpipe.images.raw import read_raw_info
from clpipe.reference.cfa import PATTERNS
from tests.conftest import DATA
from tests.conftest import cli_output as clpipe
from tests.dng import field, write_dng
from tests.test_raw import developed, mosaic

RAW = DATA / "raw"
ROSE = RAW / "rose_256x256_rggb.raw"
DUMP = ("--dump", "256x256:uint16le", "--set", "normalize.black_level=600")
DUMP += ("--set", "normalize.white_level=16383")
# Files of ../shared/data/raw, and the size of the picture or the message.
ADDITIONAL = {
    "bep_truncated.cr2": "the file is damaged, or LibRaw does not support it",
    "exiftool_DNG.dng": "this raw has only metadata and no pixels",
    "exiftool_Nikon.nef": "the file is damaged, or LibRaw does not support it",
    "magicknet_DSC8695.dng": "this file has all colours at each pixel",
    "magicknet_RAW_KODAK_DC50.KDC": (512, 768, 3),
    "mei_issue247-1.nef": "this is a JPEG, not a camera raw",
}


def looks_right(picture):
    """Whether a picture is neither dark nor bright, and neither blue nor red."""
    red, _, blue = picture.mean((0, 1))
    return 0.1 < picture.mean() < 0.7 and 0.7 < blue / red < 1.5


@pytest.mark.parametrize(("name", "expected"), ADDITIONAL.items())
def test_additional_files(shared_data, tmp_path, name, expected):
    path = shared_data / "raw" / name
    if isinstance(expected, str):
        assert f"{path}: {expected}" in clpipe("run", path, "-o", tmp_path, status=1)
        return
    clpipe("run", path, "-o", tmp_path, "--format", "png")
    picture = developed(tmp_path / f"{path.stem}.png")
    assert picture.shape == expected and looks_right(picture)


@pytest.mark.slow
def test_four_phases_of_one_picture(tmp_path):
    """A mosaic whose samples change places within each 2x2 cell stays the same picture."""
    dn = np.fromfile(ROSE, "<u2").reshape(128, 2, 128, 2).swapaxes(1, 2).reshape(128, 128, 4)
    by_colour = np.argsort([*"RGGB"], kind="stable")
    pictures = {}
    for pattern in PATTERNS:
        cells = np.empty_like(dn)
        cells[..., np.argsort([*pattern], kind="stable")] = dn[..., by_colour]
        path = tmp_path / f"{pattern}.raw"
        cells.reshape(128, 128, 2, 2).swapaxes(1, 2).tofile(path)
        options = (*DUMP, "--set", f"mosaic.pattern={pattern}")
        clpipe("run", path, "-o", tmp_path, *options, "--format", "png")
        pictures[pattern] = developed(tmp_path / f"{pattern}.png")
    assert (tmp_path / "RGGB.raw").read_bytes() == ROSE.read_bytes()
    assert all(looks_right(picture) for picture in pictures.values())
    means = {p: i[8:-8, 8:-8].reshape(60, 4, 60, 4, 3).mean((1, 3)) for p, i in pictures.items()}
    for mean in means.values():
        apart = np.abs(mean - means["RGGB"])
        assert np.median(apart) < 1 / 255 and apart.mean() < 3 / 255
        assert np.abs(mean.mean((0, 1)) - means["RGGB"].mean((0, 1))).max() < 1 / 255


def test_colours_are_those_that_libraw_makes(tmp_path):
    path = RAW / "colorchart.dng"
    clpipe("run", path, "-o", tmp_path, "--until", "color_matrix")
    own = developed(tmp_path / "colorchart.exr")
    with rawpy.imread(str(path)) as raw:
        plain = {"gamma": (1, 1), "no_auto_bright": True, "use_camera_wb": True, "output_bps": 16}
        other = raw.postprocess(**plain) / 65535
    assert own.shape == other.shape
    patches = {"white": (150, 34), "grey": (150, 142), "red": (30, 250), "green": (45, 142)}
    for name, (y, x) in patches.items():
        one, two = (i[y - 20 : y + 20, x - 20 : x + 20].mean((0, 1)) for i in (own, other))
        assert one / one.sum() == pytest.approx(two / two.sum(), abs=0.01), name


def test_a_dump_does_not_describe_itself(tmp_path):
    assert "a headerless dump of samples" in clpipe("run", ROSE, "-o", tmp_path, status=1)
    path = tmp_path / "a.raw"
    path.write_bytes(bytes(2 * 1920 * 1080))  # LibRaw takes files of this size for raws
    with pytest.raises(ImageError, match="states no camera, ISO or exposure"):
        read_raw_info(path)


def test_a_date_that_cannot_be_stops_nobody(tmp_path):
    """Year 20224: a digit too many."""
    path = tmp_path / "a.dng"
    write_dng(path, mosaic(), changes=[field(306, 2, b"20224:5:06 07:08:09")])
    clpipe("run", path, "-o", tmp_path / "out")
    assert (tmp_path / "out" / "a.jpg").is_file()
