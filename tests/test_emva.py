"""EMVA 1288: known sensors are recovered, invalid series rejected, camera series read."""

import os
from pathlib import Path

import numpy as np
import pytest

from clpipe.analysis.emva.figures import figures, saturation_index
from clpipe.analysis.emva.files import measure_series
from clpipe.analysis.emva.moments import Spatial, read_moments
from clpipe.analysis.emva.profile import emva_profile
from clpipe.analysis.emva.sensor import before_rounding, full_well, noisiest_light, rounded
from clpipe.analysis.emva.series import Exposure, Series, read_series, series_text
from clpipe.analysis.emva.simulation import saturation_of
from clpipe.camera.profile import load_camera, parse_camera
from clpipe.images.write import write_png

GAIN, EFFICIENCY, READ, DSNU, PRNU = 0.25, 0.6, 8.0, 3.0, 0.01  # DN/e-, 1, e-, e-, 1
BITS, BLACK, WIDTH, HEIGHT, STACK = 10, 40.0, 160, 128, 24
SATURATED = 6200.0  # photons, by and large
MINE = """
name = "mine"
make = "Nobody"
model = "One"
black_level = 64
white_level = 1023
white_balance_gains = [2.0, 1.5]
iso_range = [100, 100]
quantum_efficiency = 0.5
prnu = 0.01
dsnu = 4.0
{more}
[[gain_stages]]
iso = [100]
system_gain = [0.2]
read_noise = [2.0]
column_noise = [0.5]
[sources]
"""


class Sensor:
    """A sensor with known figures, only in NumPy."""

    def __init__(self, seed=0, full=1e9, quiet=1e9):
        self.random = np.random.default_rng(seed)
        self.response = 1 + PRNU * self.random.standard_normal((HEIGHT, WIDTH))
        self.offset = DSNU * self.random.standard_normal((HEIGHT, WIDTH))
        self.full = full  # e-
        self.quiet = quiet  # e-, from which on noise falls again

    def frame(self, photons):
        mean = EFFICIENCY * photons * self.response
        shot = self.random.poisson(mean) - mean
        electrons = mean + shot * np.minimum(self.quiet / np.maximum(mean, 1), 1)
        read = READ * self.random.standard_normal((HEIGHT, WIDTH))
        dn = BLACK + GAIN * (np.minimum(electrons, self.full) + self.offset + read)
        return np.clip(np.rint(dn), 0, 2**BITS - 1).astype(np.uint16)


def write_series(folder, sensor, steps=25):
    """A series of a sensor, from dark to a tenth beyond its saturation."""

    def exposure(time, photons, name, count):
        frames = [folder / "images" / f"{name}_{i}.png" for i in range(count)]
        for frame in frames:
            frame.parent.mkdir(exist_ok=True)
            write_png(frame, sensor.frame(photons))
        return Exposure(time, photons, tuple(frames))

    numbers = range(1, steps + 4)
    path = folder / "EMVA1288_Data.txt"
    half = SATURATED / 2
    series = Series(
        path,
        BITS,
        WIDTH,
        HEIGHT,
        tuple(exposure(1e7 * k / steps, SATURATED * k / steps, f"b{k}", 2) for k in numbers),
        tuple(exposure(1e7 * k / steps, 0.0, f"d{k}", 2) for k in numbers),
        exposure(5e6, half, "bs", STACK),
        exposure(5e6, 0.0, "ds", STACK),
    )
    path.write_text(series_text(series, "a sensor\nof known figures"))
    return series


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    return write_series(tmp_path_factory.mktemp("series"), Sensor())


def near(estimate, value, share):
    """Return whether an estimate is within a share of a value, and within four standard errors."""
    own = abs(estimate.value - value)
    assert own < share * value, estimate
    assert own < 4 * estimate.error + 1e-3 * value, estimate


def test_a_text_comes_back(series):
    assert read_series(series.path) == series


def test_the_figures_of_a_known_sensor(series):
    found = figures(read_moments(series))
    near(found.system_gain, GAIN, 0.02)
    near(found.responsivity, GAIN * EFFICIENCY, 0.005)
    near(found.quantum_efficiency, EFFICIENCY, 0.02)
    near(found.dark_noise, READ, 0.03)
    near(found.threshold, ((READ**2 + 1 / 12 / GAIN**2) ** 0.5 + 0.5) / EFFICIENCY, 0.03)
    near(found.dsnu.total, DSNU, 0.04)
    near(found.dsnu.pixel, DSNU, 0.04)
    near(found.prnu.total, PRNU, 0.03)
    near(found.prnu.pixel, PRNU, 0.03)
    for part in (found.dsnu.row, found.dsnu.column):
        assert part.value < 0.3 * DSNU
    full = (2**BITS - 1 - BLACK) / GAIN
    assert 0.9 * full < found.saturation_electrons.value < full
    assert found.snr_max.value == pytest.approx(found.saturation_electrons.value**0.5)
    assert found.dynamic_range.value == pytest.approx(
        found.saturation.value / found.threshold.value
    )
    assert abs(found.linearity.least.value) < 0.5 and abs(found.linearity.most.value) < 0.5
    assert found.dark_current is not None and abs(found.dark_current.value) < 200


def test_other_forms_of_the_text_are_read(series, tmp_path):
    text = series.path.read_text().replace("images/", "IMAGES\\").replace("10000000", "10000000,0")
    (tmp_path / "other.txt").write_text(
        f"\n#\n{text}".replace("IMAGES", str(series.path.parent / "images"))
    )
    other = read_series(tmp_path / "other.txt")
    assert other.bright == series.bright and other.dark_stack == series.dark_stack


LINES = {
    "unknown letter": (
        "v 3.1",
        "x 3.1",
        "line 3: found 'x 3.1'; expected a line that begins with v, n, b, d, i",
    ),
    "too few words": ("n 10 160 128", "n 10 160", "line 4: found 'n 10 160'; expected n BITS"),
    "bits": ("n 10", "n 17", "line 4: bits: found '17'; allowed: 1 to 16"),
    "size": ("n 10 160", "n 10 wide", "line 4: side: found 'wide'; allowed: 16 to 16384"),
    "twice": ("v 3.1", "n 8 20 20", "line 4: this is the second line n"),
    "no size": ("n 10 160 128", "v 3.1", "the line n BITS WIDTH HEIGHT is missing"),
    "time": ("d 5000000", "d -1", "time: found '-1'; allowed: 0 to 1e+15"),
    "no light": (" 3100", " 0", "photons: found 0; for frames without light, use a line d"),
    "one frame": ("i images/b3_1.png\n", "", "found 1 frames of this exposure; at least 2"),
    "frame of none": ("v 3.1", "i a.png", "line 3: this frame belongs to no exposure"),
    "other times": (
        "d 10000000",
        "d 1",
        "this exposure of 1e+07 ns has no counterpart without light",
    ),
    "stacks": ("b 5000000 3100", "b 1 3100", "the stacks were exposed for 1 and 5e+06 ns"),
}


@pytest.mark.parametrize("case", LINES)
def test_a_wrong_line_is_named(series, clpipe, case):
    old, new, message = LINES[case]
    text = series.path.read_text()
    assert old in text
    start = text.index("b 5000000 3100\ni images/bs") if case in ("no light", "stacks") else 0
    Path("a.txt").write_text(text[:start] + text[start:].replace(old, new, 1))
    error = clpipe("calibrate", "--emva", "a.txt", "-o", "c.toml", status=2).stderr
    assert message in error and "a.txt" in error
    assert not Path("c.toml").exists()


def only(text, *letters):
    """Remove the exposures with some letters from a text."""
    kept, keep = [], True
    for line in text.splitlines():
        keep = line[0] not in letters if line[0] in "bdnv#" else keep
        kept += [line] * keep
    return "\n".join(kept)


def test_missing_exposures_are_named(series, clpipe):
    text = series.path.read_text()
    at = text.index("b 5000000 3100\ni images/bs")
    for changed, message in (
        (only(text, "b"), "found 0 exposures of two frames with light; at least 9 are needed"),
        (only(text, "d"), "there is no exposure of two frames without light"),
        (text[:at], "found 0 stacks of more than two frames with light (b); expected one"),
    ):
        Path("a.txt").write_text(changed)
        assert message in clpipe("calibrate", "--emva", "a.txt", "-o", "c.toml", status=2).stderr
    Path("a.txt").write_bytes(b"\xff\xfe")
    assert "UTF-8" in clpipe("calibrate", "--emva", "a.txt", "-o", "c.toml", status=2).stderr
    assert (
        "no such" in clpipe("calibrate", "--emva", "b.txt", "-o", "c.toml", status=2).stderr.lower()
    )


def test_frames_that_do_not_fit_are_named(series, clpipe):
    frame = series.bright[3].frames[1]
    whole = frame.read_bytes()

    def error():
        return clpipe("calibrate", "--emva", series.path, "-o", "c.toml", status=2).stderr

    try:
        frame.unlink()
        assert f"{frame}: no such file" in error()
        frame.write_bytes(b"text")
        assert str(frame) in error()
        write_png(frame, np.zeros((HEIGHT, 20), np.uint16))
        assert f"{frame}: found 20x128 pixels, but {series.path} states 160x128" in error()
        write_png(frame, np.full((HEIGHT, WIDTH), 1024, np.uint16))
        assert f"found 1024 DN, but {series.path} states 10 bits, so at most 1023" in error()
    finally:
        frame.write_bytes(whole)


def test_a_series_without_saturation_or_noise_in_the_dark_is_refused(series, clpipe, tmp_path):
    text = series.path.read_text().replace("i images", f"i {series.path.parent}/images")
    at = text.index("\n", text.index("b20_1")) + 1
    Path("a.txt").write_text(text[:at] + text[text.index("d ", at) :])
    error = clpipe("calibrate", "--emva", "a.txt", "-o", "c.toml", status=2).stderr
    assert "the series ends before saturation" in error
    dark = series.dark_stack.frames[0]
    frame = f"i {dark}"
    black = tmp_path / "black.png"
    write_png(black, np.zeros((HEIGHT, WIDTH), np.uint16))
    Path("a.txt").write_text(text.replace(frame, f"i {black}"))
    error = clpipe("calibrate", "--emva", "a.txt", "-o", "c.toml", status=2).stderr
    assert "4.2% of the samples without light are 0 DN" in error


def test_what_does_not_go_with_a_series_is_refused(series, clpipe):
    for more, found in (("a.dng",), "FRAMES"), (("--dark", "a.dng"), "--dark"):
        arguments = ("calibrate", "--emva", series.path, "-o", "c.toml", *more)
        assert f"--emva: found {found} as well" in clpipe(*arguments, status=2).stderr
    assert "FRAMES: no frames are named" in clpipe("calibrate", "-o", "c.toml", status=2).stderr


def test_noise_is_greatest_where_it_scatters_little():
    """The saturation is the brightest of near maxima, and no scatter of clipped frames."""

    class Of:
        def __init__(self, *variance):
            self.bright = self
            self.variance = np.array(variance, float)

    assert saturation_index(Of(1, 2, 4.01, 3.9, 3.95, 4.0, 2, 0.1, 0.0)) == 5
    assert saturation_index(Of(1, 2, 3, 4, 2, 0.1, 0.0, 0.3, 0.0)) == 3


def test_rows_columns_and_pixels_are_told_apart():
    random = np.random.default_rng(1)
    rows, columns = 300, 400
    frame = 100 + 0.5 * random.standard_normal((rows, columns))
    frame += 0.3 * random.standard_normal((rows, 1)) + 0.2 * random.standard_normal(columns)
    stack = Spatial(50, frame, 0.0)
    row, column, pixel = (part.value for part in stack.parts)
    assert row == pytest.approx(0.09, rel=0.2) and column == pytest.approx(0.04, rel=0.2)
    assert pixel == pytest.approx(0.25, rel=0.02)
    assert row + column + pixel == pytest.approx(stack.variance.value)
    assert stack.stripes.value == pytest.approx(0.04, rel=0.25)
    sloping = Spatial(50, frame + np.linspace(0, 5, columns), 0.0)
    assert sloping.parts[1].value > 1
    assert sloping.stripes.value == pytest.approx(stack.stripes.value, rel=0.05)


def test_what_rounding_hides_is_found():
    random = np.random.default_rng(2)
    mean, over_time, over_pixels = 2.8, 0.28, 0.15
    pixels = mean + over_pixels * random.standard_normal((100, 1, 200))
    frames = np.rint(pixels + over_time * random.standard_normal((100, 200, 200)))
    by_pixel = frames.mean(axis=1)
    temporal = frames.var(axis=1, ddof=1).mean()
    expected = frames.mean(), temporal, by_pixel.var() - temporal / 200
    assert rounded(mean, over_time, over_pixels) == pytest.approx(expected, rel=0.02)
    found = before_rounding(*rounded(mean, over_time, over_pixels))
    assert found == pytest.approx((mean, over_time, over_pixels), rel=0.01)


def test_a_full_well_puts_the_noise_where_it_was():
    well = full_well(0.02, 0.3, 0.014, 10_000)
    assert well > 10_000
    assert noisiest_light(0.02, 0.3, 0.014, 0.02 * well) == pytest.approx(10_000, rel=0.002)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["full", "quiet"])
def test_a_sensor_that_saturates_before_its_converter(tmp_path, how):
    well = 2800
    write_series(tmp_path, Sensor(**{how: well}))
    moments, found = measure_series(tmp_path / "EMVA1288_Data.txt")
    camera = parse_camera(emva_profile("c", 100, "a series", moments, found), "c")
    if how == "full":  # its frames end there, and so does the profile
        assert camera.white_level == pytest.approx(BLACK + GAIN * well, rel=0.03)
        assert camera.full_well is None
    else:
        assert camera.white_level == 2**BITS - 1
        assert "before the converter ends" in camera.sources["full_well"]
    assert saturation_of(camera, 100) == pytest.approx(found.saturation_electrons.value, rel=0.06)


@pytest.mark.slow
def test_a_camera_comes_back(clpipe):
    """A series of a profile gives its figures, and a profile whose series has the same ones."""
    Path("mine.toml").write_text(MINE.format(more=""))
    mine = load_camera("mine.toml")
    options = ("--size", "128x96", "--exposures", 15, "--stack", 30, "--device", "numpy")
    text = clpipe("emva", "--camera", "mine.toml", "-o", "one", *options).stdout
    assert "17 exposures of two frames" in text and "stacks of 30" in text
    assert len(list(Path("one/images").iterdir())) == 4 * 17 + 2 * 30
    measure = ("calibrate", "--emva", "one/EMVA1288_Data.txt", "-o", "again.toml", "--iso", 100)
    table = clpipe(*measure).stdout
    assert "quantum efficiency" in table and "wrote again.toml and again.png" in table
    assert Path("again.png").read_bytes().startswith(b"\x89PNG")
    again = load_camera("again.toml")
    assert again.noise(100).emva().system_gain == pytest.approx(0.2, rel=0.02)
    assert again.noise(100).b == pytest.approx(mine.noise(100).b, rel=0.03)
    assert again.quantum_efficiency == pytest.approx(0.5, rel=0.02)
    assert again.prnu == pytest.approx(0.01, rel=0.05)
    assert again.white_level == 1023 and again.black_level == pytest.approx(64, abs=0.1)
    assert again.column_noise(100) == pytest.approx(mine.column_noise(100), rel=0.15)
    assert again.dsnu == pytest.approx(4, rel=0.15)
    assert again.full_well is None
    first = measure_series(Path("one/EMVA1288_Data.txt"))[1].record()
    clpipe("emva", "--camera", "again.toml", "-o", "two", *options)
    repeated = measure_series(Path("two/EMVA1288_Data.txt"))[1].record()
    for name in ("system_gain", "quantum_efficiency", "dark_noise", "saturation", "snr_max"):
        assert repeated[name]["value"] == pytest.approx(first[name]["value"], rel=0.03), name
    for name in ("dsnu", "prnu"):
        total, own = repeated[name]["total"], first[name]["total"]
        assert total["value"] == pytest.approx(own["value"], rel=0.05), name


@pytest.mark.slow
def test_a_series_is_the_same_again_and_replaces_none(clpipe):
    Path("mine.toml").write_text(MINE.format(more="dark_current = 3000"))
    small = ("--size", "32x16", "--exposures", 9, "--stack", 3, "--device", "numpy")
    for folder in ("one", "two"):
        clpipe("emva", "--camera", "mine.toml", "-o", folder, *small)
    for path in Path("one").rglob("*.*"):
        assert (Path("two") / path.relative_to("one")).read_bytes() == path.read_bytes()
    frames = read_series(Path("one/EMVA1288_Data.txt")).bright[0].frames
    assert frames[0].read_bytes() != frames[1].read_bytes()
    again = clpipe("emva", "--camera", "mine.toml", "-o", "one", *small, status=2)
    assert "this folder already contains a series" in again.stderr
    for wrong, message in (
        (("--size", "8x900"), "--size: found '8x900'; expected WIDTHxHEIGHT"),
        (("--iso", "200"), "iso: found 200, but camera mine goes from 100 to 100"),
        (("--camera", "nikn-d850"), "nikon-d850"),
    ):
        arguments = ("emva", "--camera", "mine.toml", "-o", "three", *small)
        arguments = (*arguments[:1], *arguments[3:]) if "--camera" in wrong else arguments
        arguments = tuple(
            a for a in arguments if a not in ("--size", "32x16") or wrong[0] != "--size"
        )
        assert message in clpipe(*arguments, *wrong, status=2).stderr
    assert not Path("three").exists()


# What the package emva1288 1.0.2 (PyPI) finds in the series of EMVA1288/datasets (GitHub): K, QE %,
# sigma_d e-, u_p.sat, SNRmax, DR, DSNU e-, PRNU %, LE_min and LE_max %.
PACKAGE = {
    "EMVA1288_ReferenceSet_001_CCD_12Bit": (
        *(0.280063, 45.2495, 10.9244, 30957, 118.355, 1220.95, 0.553188, 0.432705),
        *(-0.615798, 0.480448),
    ),
    "EMVA1288_ReferenceSet_002_CMOS_08Bit": (
        *(0.0205553, 54.9755, 19.2559, 19384, 103.230, 437.941, 6.43809, 1.41798),
        *(-0.896178, 0.854259),
    ),
    "EMVA1288_ReferenceSet_003_Simulation_12Bit": (
        *(0.0978588, 50.3688, 30.6473, 81323.3, 202.390, 1309.14, 21.7392, 0.966895),
        *(-0.965698, 0.381741),
    ),
}


@pytest.mark.parametrize("name", PACKAGE)
def test_the_reference_sets(name):
    folder = os.environ.get("CLPIPE_EMVA")
    if not folder:
        pytest.skip("needs a clone of EMVA1288/datasets; set CLPIPE_EMVA to its path")
    found = figures(read_moments(read_series(Path(folder) / name / "EMVA1288_Data.txt")))
    ours = (
        found.system_gain.value,
        100 * found.quantum_efficiency.value,
        found.dark_noise.value,
        found.saturation.value,
        found.snr_max.value,
        found.dynamic_range.value,
        found.dsnu.total.value,
        100 * found.prnu.total.value,
        found.linearity.least.value,
        found.linearity.most.value,
    )
    assert ours == pytest.approx(PACKAGE[name], rel=1e-4)
