"""Noise on finished pictures: from parameters, or measured on another picture."""

import json

import numpy as np
import pytest
from PIL import Image

from clpipe.base.errors import RequestError
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.plan import make_plan
from clpipe.stage import Kind
from clpipe.stages.picture_noise import measured_noise
from tests.conftest import STILL_LIFE, noise_report
from tests.conftest import cli_output as clpipe

CLEAN = ("sensor_noise", "row_noise", "column_noise", "denoise")


def chain(**values):
    return make_chain(settings_from({"stages": ["picture_noise"], "picture_noise": values}))


def noisy(develop, image, key="k", **values):
    settings = {"stages": ["picture_noise"], "picture_noise": values}
    return develop(image, key, source=Kind.DISPLAY, **settings).final


@pytest.fixture
def grey():
    return np.full((300, 400, 3), 0.5, np.float32)


@pytest.fixture
def report(tmp_path):
    """A report as clpipe measure writes one, with changes."""

    def write(name="report.json", **changes):
        path = tmp_path / name
        path.write_text(json.dumps(noise_report(0.01, 0.02, 0.03, **changes)))
        return str(path)

    return write


def test_no_noise_costs_nothing():
    with_it, without = (
        make_plan(make_chain(settings_from({"skip": skip}))) for skip in ([], ["picture_noise"])
    )
    assert with_it == without


def test_a_chain_may_end_before_the_display():
    linear = settings_from({"skip": ["tone_curve", "gamma"]})
    assert make_chain(linear).names[-1] == "sharpen"
    loud = {"method": "iid_gaussian", "sigma": 0.1}
    with pytest.raises(RequestError, match="picture_noise reads display, but sharpen gives"):
        make_chain(settings_from({"skip": ["tone_curve", "gamma"], "picture_noise": loud}))


@pytest.mark.slow
def test_sigma_is_as_given_and_channels_are_independent(develop, grey):
    image = noisy(develop, grey, method="iid_gaussian", sigma=[0.01, 0.02, 0.04]) - grey
    assert image.std((0, 1)) == pytest.approx([0.01, 0.02, 0.04], rel=0.01)
    assert np.abs(np.corrcoef(image.reshape(-1, 3).T) - np.eye(3)).max() < 0.015
    one = noisy(develop, grey, method="iid_gaussian", sigma=0.02) - grey
    assert one.std((0, 1)) == pytest.approx([0.02] * 3, rel=0.01)


def test_noise_is_new_in_each_image(develop, grey):
    one, again, other = (
        noisy(develop, grey, key, method="iid_gaussian", sigma=0.02) - grey for key in "aab"
    )
    assert np.array_equal(one, again)
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.01


@pytest.mark.slow
def test_sigma_follows_intensity(develop, grey):
    for level, sigma in ((-1, 0.01), (0, 0.01), (0.25, 0.03), (0.5, 0.05), (0.75, 0.025), (1, 0)):
        image = np.full_like(grey, level)
        values = {"method": "intensity_dependent", "sigma": [0.01, 0.05, 0]}
        assert (noisy(develop, image, **values) - image).std() == pytest.approx(sigma, rel=0.02)


def test_measured_sigma(develop, grey, report):
    path = report()
    for match, expected in (("picture", 1), ("flat", 1 / 2), ("halved", 2**0.5)):
        values = {"measured": path, "match": match, "correlated": match == "flat"}
        noise = noisy(develop, grey, method="iid_gaussian", **values) - grey
        assert noise.std((0, 1)) == pytest.approx(
            np.multiply(expected, [0.01, 0.02, 0.03]), rel=0.01
        )
        if match == "halved":
            left = noise.reshape(150, 2, 200, 2, 3).mean((1, 3)).var((0, 1))
            assert left == pytest.approx(np.square([0.01, 0.02, 0.03]) / 2, rel=0.02)
        red_green, red_blue, green_blue = np.corrcoef(noise.reshape(-1, 3).T)[[0, 0, 1], [1, 2, 2]]
        assert red_green == pytest.approx(0.5 if match == "flat" else 0, abs=0.015)
        assert (red_blue, green_blue) == pytest.approx((0, 0), abs=0.015)
        for level, factor in ((0.0, 1), (0.5, 2), (1.0, 3)):
            image = np.full_like(grey, level)
            found = noisy(develop, image, method="intensity_dependent", **values) - image
            sigma = np.multiply(expected * factor / 5**0.5, [0.01, 0.02, 0.03])
            assert found.std((0, 1)) == pytest.approx(sigma, rel=0.02)


def test_rounding_is_not_added_twice(tmp_path, develop):
    """Noise of one level, in files of 8 bits: measured, put on, rounded, and measured again."""
    random, clean = np.random.default_rng(8), np.full((256, 256, 3), 128.3)

    def measured(name, noisy):
        for end, pixels in (("noisy", noisy), ("clean", clean)):
            picture = Image.fromarray(pixels.round().astype(np.uint8))
            picture.save(tmp_path / f"{name}_{end}.png")
        paths = (tmp_path / f"{name}_{end}.png" for end in ("noisy", "clean"))
        frame, truth = paths
        (tmp_path / f"{name}.json").write_text(clpipe("measure", frame, "--truth", truth, "--json"))
        report = json.loads((tmp_path / f"{name}.json").read_text())
        return np.diag(report["covariance"]["picture"]) * 255**2

    clean += random.uniform(-9, 9, clean.shape)  # so that the truth's rounding counts
    before = measured("one", clean + random.normal(0, 1, clean.shape))
    assert before == pytest.approx([1 + 2 / 12] * 3, rel=0.02)
    values = {"method": "iid_gaussian", "measured": str(tmp_path / "one.json")}
    again = noisy(develop, (clean / 255).astype(np.float32), **values)
    assert measured("two", again * 255.0) == pytest.approx(before, rel=0.025)


def test_a_report_on_several_isos(tmp_path):
    path = tmp_path / "isos.json"
    by_iso = {"100": noise_report(0.01, 0.01, 0.01), "800": noise_report(0.03, 0.03, 0.03)}
    path.write_text(json.dumps({"by_iso": by_iso}))
    values = {"method": "iid_gaussian", "measured": str(path)}

    def sigma(iso):
        settings = {"stages": ["picture_noise"], "picture_noise": values, "iso": iso}
        return make_chain(settings_from(settings)).steps[0].method.sigma

    assert sigma(100) == pytest.approx((0.01,) * 3) and sigma(800) == pytest.approx((0.03,) * 3)
    with pytest.raises(
        RequestError, match=r"isos\.json does not contain ISO 400; it contains 100, 800"
    ):
        sigma(400)


@pytest.mark.parametrize("method", ["iid_gaussian", "intensity_dependent"])
def test_channels_are_correlated_as_given(develop, grey, method):
    expected = (0.8, -0.4, 0.1)
    noise = noisy(develop, grey, method=method, sigma=[0.02] * 3, correlation=expected) - grey
    assert noise.std((0, 1)) == pytest.approx([0.02] * 3, rel=0.01)
    table = np.corrcoef(noise.reshape(-1, 3).T)
    assert table[[0, 0, 1], [1, 2, 2]] == pytest.approx(expected, abs=0.015)
    beside = np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]
    assert abs(beside) < 0.015


def test_a_report_that_changes_is_read_again(report):
    before = measured_noise(report())[None]["picture"].sigma
    path = report(channels=json.loads('{"R": 0}'))
    assert before == pytest.approx((0.01, 0.02, 0.03))
    with pytest.raises(ValueError, match="not a report"):
        measured_noise(path)


@pytest.mark.parametrize("method", ["iid_gaussian", "intensity_dependent"])
def test_rejected_baselines(method, report, tmp_path):
    broken = tmp_path / "broken.json"
    broken.write_text("{")
    sigma = [0.1, 0.2, 0.3]
    for values, message in (
        ({}, "picture_noise: set sigma, or set measured"),
        ({"sigma": sigma, "measured": report()}, "sigma and measured are both set"),
        ({"measured": "nowhere.json"}, r"picture_noise\.measured.*cannot be read: No such file"),
        ({"measured": str(tmp_path)}, "cannot be read"),
        ({"measured": str(broken)}, "not a report of clpipe measure --json"),
        (
            {"measured": report("raw.json", kind="mosaic")},
            "this report measures mosaic images",
        ),
        ({"sigma": [0.1, 0.2, 1.5]}, r"picture_noise\.sigma.*1\.5.*less than or equal to 1"),
        ({"sigma": [0.1, -0.2, 0.3]}, "greater than or equal to 0"),
        ({"sigma": [0.1]}, "sigma"),
        ({"sigma": "loud"}, "sigma"),
        ({"sigma": sigma, "correlated": True}, "correlated is true, but no measured noise is set"),
        ({"sigma": sigma, "correlation": [0.9, 0.9, -0.9]}, "no three channels can be correlated"),
        ({"sigma": sigma, "correlation": [2, 0, 0]}, "less than or equal to 1"),
        ({"sigma": sigma, "match": "flatt"}, "picture_noise.match"),
    ):
        with pytest.raises(RequestError, match=message):
            chain(method=method, **values)
    for records in ({"R": {}}, {"R": {"sigma": None}}, [], dict.fromkeys("RGB", 1)):
        with pytest.raises(RequestError, match="not a report"):
            chain(method=method, measured=report(channels=records))
    for means, sigmas in (([], []), ([0, 1], [0]), ([0, 1], [0, 1e300]), ([0, 1], [-1, 0])):
        curve = {"mean": means, "sigma": sigmas, "samples": [1] * len(means)}
        record = {"intensity": curve, "intensity_picture": curve}
        with pytest.raises(RequestError, match="not a report"):
            chain(method=method, measured=report(channels=dict.fromkeys("RGB", record)))
    for table in ([[1]], [[-1, 0, 0]] * 3, [[1e300, 0, 0]] * 3, "loud", [[None] * 3] * 3):
        places = dict.fromkeys(("flat", "picture", "halved"), table)
        with pytest.raises(RequestError, match="not a report"):
            chain(method=method, measured=report(covariance=places))


def test_a_configuration_names_the_report_relative_to_itself(report, tmp_path):
    report()
    text = '[picture_noise]\nmethod = "iid_gaussian"\nmeasured = "report.json"\n'
    (tmp_path / "baseline.toml").write_text(text)
    printed = clpipe("plan", "--toml", "-c", tmp_path / "baseline.toml")
    assert "# sigma = [0.01, 0.02, 0.03]  # automatic: as measured" in printed


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    """A camera's noise measured, put on clean pictures by each method, and measured there."""
    folder = tmp_path_factory.mktemp("loop")
    clean = [x for name in CLEAN for x in ("--skip", name)]

    def run(name, *options):
        formats = ("--iso", 3200, "--format", "exr", "--format", "png")
        clpipe("run", STILL_LIFE, "-o", folder / name, *formats, *options)

    def measure(name):
        paths = (folder / n / "still_life.exr" for n in (name, "clean"))
        frame, truth = paths
        return clpipe("measure", frame, "--truth", truth, "--json")

    run("camera")
    run("clean", *clean)
    reports = {"camera": json.loads(measure("camera"))}
    (folder / "camera.json").write_text(json.dumps(reports["camera"]))
    for method, match in (("iid_gaussian", "picture"), ("intensity_dependent", "flat")):
        noise = ("--set", f"picture_noise.method={method}", "--set", f"picture_noise.match={match}")
        noise += ("--set", f"picture_noise.measured={folder / 'camera.json'}")
        run(method, *clean, *noise)
        reports[method] = json.loads(measure(method))
    return reports


@pytest.mark.slow
def test_the_matched_variance_is_measured_again(loop):
    for name in "RGB":
        camera, baseline = (loop[x]["channels"][name] for x in ("camera", "iid_gaussian"))
        assert baseline["sigma_picture"] == pytest.approx(camera["sigma_picture"], rel=0.03)
        assert np.std(baseline["intensity"]["sigma"]) < 0.1 * np.std(camera["intensity"]["sigma"])


@pytest.mark.slow
def test_the_matched_curve_is_measured_again(loop):
    for name in "RGB":
        camera, baseline = (
            loop[x]["channels"][name]["intensity"] for x in ("camera", "intensity_dependent")
        )
        mean, sigma = np.array(camera["mean"]), np.array(camera["sigma"])
        enough = np.array(camera["samples"]) > 2000
        found = np.interp(mean, baseline["mean"], baseline["sigma"])
        assert enough.sum() > 8
        off = np.abs(found / sigma - 1)
        assert np.average(off, weights=camera["samples"]) < 0.03
        assert off[enough].max() < 0.15  # next to a peak the bins, means, differ more


@pytest.mark.slow
def test_baselines_have_the_size_but_not_the_shape_of_camera_noise(loop):
    for name in ("R", "G", "B", "Y", "Cb", "Cr"):
        camera = loop["camera"]["channels"][name]
        assert camera["energy_left_2x2"] > 0.55
        for method in ("iid_gaussian", "intensity_dependent"):
            baseline = loop[method]["channels"][name]
            table = np.array(baseline["autocorrelation"])
            table[8, 8] = 0
            assert np.abs(table).max() < 0.015
            assert baseline["energy_left_2x2"] == pytest.approx(0.25, abs=0.005)
            # Colour differences mix sigmas of three intensities, and so are no Gaussian.
            assert abs(baseline["excess_kurtosis"]) < (0.05 if name in "RGB" else 0.3)
    assert loop["camera"]["correlation"]["R-G"] > 0.3
    assert abs(loop["iid_gaussian"]["correlation"]["R-G"]) < 0.01
