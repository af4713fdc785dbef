"""Camera profiles: sources, interpolation, rejected values."""

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.camera.profile import built_in_cameras, built_in_name, load_camera
from clpipe.camera.text import normalized_name
from clpipe.chain.isos import check_cameras

NAMES = tuple(built_in_cameras())
PROFILE = """name = "mine"
make = "M"
model = "X"
black_level = 64
white_level = 1023
white_balance_gains = [2.0, 1.5]
iso_range = [100, 6400]
dsnu = 1.0

[[gain_stages]]
iso = [100, 200, 400]
system_gain = [0.1, 0.2, 0.4]
read_noise = [1.0, 1.1, 1.4]
row_noise = [0.10, 0.12, 0.14]

[[gain_stages]]
iso = [800, 1600]
system_gain = [0.8, 1.6]
read_noise = [0.9, 1.7]

[sources]
all = "made up"
"""


@pytest.fixture
def own(tmp_path):
    def write(*changes: tuple[str, str]):
        text = PROFILE
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "mine.toml").write_text(text)
        return load_camera(str(tmp_path / "mine.toml"))

    return write


# Published figures by camera and ISO. AB has a and b. The others have the system gain in DN/e- and
# the noise of a dark pixel in DN.
AB = {
    ("apple-iphone-7", 800): (7.2e-4, 3e-6),
    ("google-pixel", 800): (1.76e-3, 1.2e-5),
    ("lg-g4", 800): (3.36e-3, 6.3e-5),
    ("motorola-nexus-6", 800): (3.48e-3, 5.2e-5),
    ("samsung-galaxy-s6", 800): (3.70e-3, 2e-6),
    ("xiaomi-poco-f3", 1600): (1.196e-6 * 1600 + 2.14e-6, 5.07e-12 * 1600**2 + 3.28e-7),
    ("canon-5d3", 100): (1 / 67684, None),
    ("canon-5d3", 6400): (1 / 1085, None),
    ("canon-6d", 3200): (1 / 2568, None),
}
DN = {
    ("nikon-d850", 6400): (26.6, 26.6**0.563 * np.exp(0.799)),
    ("canon-5d4", 6400): (13.96, 13.96**0.677 * np.exp(1.512)),
    ("canon-700d", 100): (0.448, 0.448**0.652 * np.exp(2.080)),
    ("canon-70d", 6400): (26.1, 26.1**0.568 * np.exp(1.998)),
    ("sony-imx686", 100): (0.0838, 0.693),
    ("sony-imx686", 6400): (8.74, 14.3),
    ("sony-imx385", 1600): (3.513, 11.92**0.5),
    ("sony-imx385", 25600): (52.033, 1819.8**0.5),
    ("sony-a7r", 100): (0.330, None),
    ("sony-a7r3", 100): (0.384, 0.384 * (0.705**2 + 3.03**2) ** 0.5),
    ("samsung-galaxy-s9", 100): (0.3125, 0.3125 * (1.063**2 + 2.37**2) ** 0.5),
    ("nikon-d7000", 800): (None, 9.717),
}
DARKTABLE = {  # green a at ISO 1600 in its noiseprofiles.json
    "nikon-d800": 2.419e-05,
    "nikon-d600": 1.698e-05,
    "sony-a7m2": 2.622e-05,
    "canon-80d": 5.071e-05,
    "nikon-d750": 1.627e-05,
}


@pytest.mark.parametrize(("name", "iso"), [*AB, *DN])
def test_the_noise_is_what_was_published(name, iso):
    camera = load_camera(name)
    noise = camera.noise(iso)
    if (name, iso) in AB:
        a, b = AB[name, iso]
    else:
        gain, read_noise = DN[name, iso]
        a = gain and gain / camera.signal_range
        b = read_noise and (read_noise / camera.signal_range) ** 2
    assert a is None or noise.a == pytest.approx(a, rel=0.003)
    assert b is None or noise.b == pytest.approx(b, rel=0.006)


@pytest.mark.parametrize("name", DARKTABLE)
def test_a_of_darktable_is_converted(name):
    camera = load_camera(name)
    # The profile has the mean over ISOs, which its source says.
    assert camera.noise(1600).a == pytest.approx(12.8 * DARKTABLE[name], rel=0.05)
    assert "30 %" in camera.sources["system_gain"]


def test_there_are_many_cameras_and_their_matrices_are_of_cameras():
    cameras = [load_camera(name) for name in NAMES]
    assert len(cameras) >= 25
    with_matrix = [camera for camera in cameras if camera.xyz_to_camera]
    assert len(with_matrix) >= 18
    for camera in with_matrix:
        colours = camera.srgb_to_camera()
        assert np.allclose(colours.sum(1), 1)
        assert (np.diag(colours) > 0.4).all(), camera  # each channel sees most of its own colour
        neutral = np.array(camera.xyz_to_camera) @ [0.9505, 1, 1.089]
        gains = neutral[1] / neutral[0], neutral[1] / neutral[2]
        assert camera.white_balance_gains == pytest.approx(gains, rel=0.01)


@pytest.mark.parametrize(
    ("called", "name"),
    [
        ("Nikon D850", "nikon-d850"),
        ("nikon d850", "nikon-d850"),
        ("NIKON CORPORATION NIKON D850", "nikon-d850"),  # EXIF's Make and Model
        ("D850", "nikon-d850"),
        ("Canon EOS 5D Mark III", "canon-5d3"),
        ("Canon Canon EOS 5D Mark III", "canon-5d3"),
        ("canon 5d mark iii", "canon-5d3"),
        ("EOS 5D Mark III", "canon-5d3"),
        ("Sony A7 II", "sony-a7m2"),
        ("SONY ILCE-7M2", "sony-a7m2"),
        ("Sony A7R II", "sony-a7r2"),
        ("Canon EOS REBEL T5i", "canon-700d"),
        ("Redmi K40", "xiaomi-poco-f3"),
        ("sony-a7s2", "sony-a7s2"),
    ],
)
def test_a_camera_is_found_by_what_it_is_called(called, name):
    assert built_in_name(called) == name
    assert load_camera(called).name == name


def test_settings_hold_a_camera_by_one_name_however_it_is_called(tmp_path):
    from clpipe.chain.files import load_settings
    from clpipe.chain.settings import settings_from
    from clpipe.inputs.manifest import check_rows, read_manifest
    from clpipe.pipeline import Pipeline

    (tmp_path / "a.toml").write_text('camera = "Nikon D850"\n')
    assert load_settings(str(tmp_path / "a.toml")).camera == "nikon-d850"
    (tmp_path / "a.csv").write_text("path,camera\na.exr,Sony A7 II\n")
    check_rows(read_manifest(tmp_path / "a.csv"), settings_from({}))
    check_cameras(settings_from({"camera": {"choice": ["Nikon D850", "canon 80d"]}}))
    assert Pipeline(camera="EOS 5D Mark III", device="numpy").chain.camera.name == "canon-5d3"


def test_no_two_cameras_are_called_alike():
    seen: dict[str, str] = {}
    for name in NAMES:
        camera = load_camera(name)
        for model in (name, camera.model, *camera.aliases):
            for called in (normalized_name(model), normalized_name(f"{camera.make} {model}")):
                assert seen.setdefault(called, name) == name, called


@pytest.mark.parametrize("called", ["Nikon D850s", "nikon_d580", "Nikkon D850"])
def test_a_name_that_is_nearly_right(called):
    assert built_in_name(called) is None
    with pytest.raises(
        RequestError, match=r"unknown camera .*most similar: nikon-d850.*'clpipe cal"
    ):
        load_camera(called)


# Shapes of read noise as they are published, by camera and ISO.
SHAPES = {
    ("canon-5d4", 800): 0.093,
    ("canon-70d", 800): -0.031,
    ("canon-700d", 800): -0.018,
    ("nikon-d850", 800): -0.177,
    ("sony-imx385", 1600): 0.015,
    ("sony-imx686", 100): 0.102,
    ("sony-a7s2", 100): 0.149,
    ("sony-a7s2", 25600): -0.091,
}


@pytest.mark.parametrize(("name", "iso"), SHAPES)
def test_the_shape_of_read_noise_is_what_was_published(name, iso):
    camera = load_camera(name)
    assert camera.tukey_lambda_at(iso) == pytest.approx(SHAPES[name, iso])
    assert "github.com" in camera.sources["tukey_lambda"]
    if camera.full_well:  # it bounds what the lowest ISO shows, and nothing else
        first = camera.gain_stages[0].iso
        shown = [camera.signal_of(camera.full_well, i) for i in first if i >= 100]
        assert min(shown) == pytest.approx(1, rel=0.01)


def test_the_black_level_of_the_a7s2_is_what_was_published():
    camera = load_camera("sony-a7s2")
    for iso, bias, error in ((6400, -2.254, 0.0591), (1600, 2.428, 0.0388)):
        assert np.multiply(camera.color_bias(iso), 15871) == pytest.approx([bias] * 4)
        assert camera.black_level_error(iso) * 15871 == pytest.approx(error)


@pytest.mark.parametrize("name", NAMES)
def test_every_number_of_a_profile_has_a_source(name):
    camera = load_camera(name)
    assert camera.name == name
    gain = {"gain_stages"} & camera.sources.keys() or {"system_gain", "read_noise"}
    for key in (*gain, "levels", "white_balance_gains", "xyz_to_camera", "full_well"):
        assert len(camera.sources[key]) > 10, key
    text = " ".join([*camera.sources, *camera.sources.values()])
    for what in ("row", "column", "PRNU", "DSNU", "hot"):
        assert what in text


@pytest.mark.parametrize("name", NAMES)
def test_noise_grows_with_the_iso_and_never_jumps_within_a_gain_stage(name):
    camera = load_camera(name)
    ends = [stage.iso[0] * 0.999 for stage in camera.gain_stages[1:]] + [camera.iso_range[1]]
    for stage, end in zip(camera.gain_stages, ends, strict=True):
        first = max(stage.iso[0], camera.iso_range[0])
        isos = np.geomspace(first, end, 50 if first < end else 1)
        a = np.array([camera.noise(iso).a for iso in isos])
        b = np.array([camera.noise(iso).b for iso in isos])
        assert np.all(np.diff(a) > 0)
        assert np.all(np.abs(np.diff(np.log(b))) < 0.5)
    low, high = camera.iso_range
    for iso in (low, high):
        assert 0 < camera.noise(iso).a < 0.1


def test_between_isos_figures_lie_between_those_of_the_stage(own):
    camera = own()
    unit = 1023 - 64
    for iso, gain, read in ((100, 0.1, 1.0), (400, 0.4, 1.4), (800, 0.8, 0.9)):
        noise = camera.noise(iso)
        assert noise.a == pytest.approx(gain / unit)
        assert noise.b == pytest.approx((read / unit) ** 2)
    middle = camera.noise(200 * 2**0.5)
    assert middle.a == pytest.approx(0.2 * 2**0.5 / unit)
    electrons = (1.1 / 0.2 + 1.4 / 0.4) / 2  # half way in log ISO
    assert middle.b == pytest.approx((electrons * 0.2 * 2**0.5 / unit) ** 2)
    # The first stage holds until the second begins, with its own electrons.
    last = camera.noise(799)
    assert last.b == pytest.approx((1.4 / 0.4 * 0.4 * 799 / 400 / unit) ** 2)
    assert camera.noise(6400).a == pytest.approx(6.4 / unit)


def test_row_noise_comes_from_its_table_or_from_its_ratio(own):
    unit = 1023 - 64
    camera = own(
        ("[[gain_stages]]\niso = [100", "row_noise_ratio = 0.5\n[[gain_stages]]\niso = [100")
    )
    assert camera.row_noise(200) == pytest.approx(0.12 / unit)
    assert camera.row_noise(800) == pytest.approx(0.5 * 0.9 / unit)
    assert camera.column_noise(800) == 0


def test_what_arises_after_the_gain_is_what_the_fit_says(own):
    # read^2 = gain^2 * 2^2 + 0.9^2
    reads = [round((4 * g * g + 0.81) ** 0.5, 6) for g in (0.1, 0.2, 0.4)]
    camera = own(("read_noise = [1.0, 1.1, 1.4]", f"read_noise = {reads}"))
    for iso in (100, 200, 400):
        emva = camera.noise(iso).emva()
        assert emva.adc_noise == pytest.approx(0.9, rel=1e-4)
        assert emva.read_noise == pytest.approx(2.0, rel=1e-3)
    assert camera.noise(800).after == 0  # two ISOs do not tell
    assert camera.noise(400).paper().theta == pytest.approx(4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("system_gain = [0.1, 0.2, 0.4]\n", "", r"gain_stages\[0\]\.system_gain: missing"),
        (
            "[0.1, 0.2, 0.4]",
            "[0.1, -0.2, 0.4]",
            r"gain_stages\[0\]\.system_gain\[1\]: found -0.2: .*greater than 0",
        ),
        ("[0.10, 0.12, 0.14]", "[0.10]", "row_noise must be as long as iso; found 1 and 3"),
        ("dsnu = 1.0", "dsnu = -1", "dsnu: .*greater than or equal to 0"),
        ("dsnu = 1.0", 'dsnu = "much"', "dsnu: .*valid number"),
        ("dsnu = 1.0", "hot_pixel_share = 1e-5", "hot_pixel_share needs hot_pixel_level"),
        (
            "[sources]",
            "[[gain_stages]]\nios = [1]\n\n[sources]",
            "gain_stages.2.*(missing|unknown)",
        ),
        ("dsnu = 1.0", "full_wel = 1", "unknown key 'full_wel' .did you mean 'full_well'"),
        (
            "iso = [800, 1600]",
            "iso = [300, 1600]",
            "gain_stages must ascend in iso and not overlap",
        ),
        ("iso_range = [100, 6400]", "iso_range = [6400, 100]", "iso_range must ascend"),
        ("iso_range = [100, 6400]", "iso_range = [10, 50]", "before the first gain stage"),
        ("white_level = 1023", "white_level = 70000", "white_level: .*65535"),
        ("[sources]", "[source]", "sources: missing"),
        ("white_level = 1023", "white_level = 64", "white_level must be above black_level"),
        ("iso = [800, 1600]", "iso = [1600, 800]", "iso must ascend"),
        ('name = "mine"', "name = ", "not valid TOML"),
    ],
)
def test_a_profile_that_cannot_be_is_refused(own, old, new, message):
    with pytest.raises(RequestError, match=r"mine\.toml: .*" + message):
        own((old, new))


def test_an_iso_that_the_camera_has_not(own):
    with pytest.raises(RequestError, match="found 12800, but camera mine goes from 100 to 6400"):
        own().check_iso(12800)
    assert own().noise(12800).a == pytest.approx(2 * own().noise(6400).a)  # pushed
    with pytest.raises(RequestError, match="found 25601, but camera mine goes from 100 to 6400"):
        own().noise(25601)
