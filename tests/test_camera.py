"""Camera profiles: sources, interpolation, what is refused."""

import numpy as np
import pytest

from clpipe.base.errors import RequestError
from clpipe.camera.profile import built_in_cameras, load_camera

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
    for stage in camera.gain_stages:
        isos = np.geomspace(stage.iso[0], stage.iso[-1], 200)
        a = np.array([camera.noise(iso).a for iso in isos])
        b = np.array([camera.noise(iso).b for iso in isos])
        assert np.all(np.diff(a) > 0)
        assert np.all(np.abs(np.diff(np.log(b))) < 0.2)
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
    ],
)
def test_a_profile_that_cannot_be_is_refused(own, old, new, message):
    with pytest.raises(RequestError, match=r"mine\.toml: .*" + message):
        own((old, new))


def test_an_iso_that_the_camera_has_not(own):
    with pytest.raises(RequestError, match="found 12800, but camera mine goes from 100 to 6400"):
        own().noise(12800)
