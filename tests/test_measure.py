"""clpipe measure as a command: real runs, foreign files, rejected inputs."""

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from clpipe.analysis.measure import measure
from clpipe.analysis.pictures import Picture, load_picture
from clpipe.analysis.pooling import pool_by_iso
from clpipe.base.errors import RequestError
from clpipe.camera.profile import load_camera
from clpipe.commands.measure import measure_tables
from clpipe.images.read import read_image
from clpipe.images.write import write_exr
from tests.conftest import STILL_LIFE, run_cli


@pytest.fixture
def measured(clpipe):
    """The JSON report on images."""
    return lambda *arguments: json.loads(clpipe("measure", *arguments, "--json").stdout)


@pytest.fixture(scope="module")
def developed(tmp_path_factory):
    """Develop the still life once with some options, and return the start of its file names.

    It is the middle of the still life, of 640x480 px.
    """
    render = tmp_path_factory.mktemp("render") / "still_life.exr"
    middle = read_image(STILL_LIFE).pixels[80:560, 160:800]
    write_exr(render, middle, "RGB", {}, half=True)

    @cache
    def develop(*options):
        folder = tmp_path_factory.mktemp("developed")
        iso = () if "--iso" in options else ("--iso", "3200")
        arguments = ["run", render, "-o", folder, *iso, *options]
        run_cli(*arguments)
        return f"{folder}/still_life"

    return develop


@pytest.mark.slow
def test_the_raw_has_the_noise_of_the_camera(developed, measured):
    noisy = developed("--until", "quantize")
    clean = developed("--until", "quantize", "--skip", "noise")
    report = measured(f"{noisy}.exr", "--truth", f"{clean}.exr")
    noise = load_camera("sony-a7r2").noise(3200)
    assert list(report["channels"]) == ["R", "G1", "G2", "B", "mosaic"]
    for name, one in report["channels"].items():
        law = one["law"]
        assert law["a"] == pytest.approx(noise.a, rel=0.03)
        assert law["b"] == pytest.approx(noise.b, rel=0.1)
        assert one["column"]["sigma"] <= one["column"]["limit"]
        assert abs(one["excess_kurtosis"]) < 0.12  # the dark pixels have few electrons
        assert one["energy_left_2x2"] == pytest.approx(0.25, abs=0.006)
        assert one["sigma_picture"] == pytest.approx(one["sigma"], rel=0.03)
        pixels = 640 * 480 if name == "mosaic" else 320 * 240
        assert 0.95 * pixels < one["samples"] <= pixels


@pytest.mark.slow
def test_row_noise_is_found_and_shared_by_the_sites_of_a_row(developed, measured):
    noisy = developed("--until", "quantize", "--set", "row_noise.sigma=0.004")
    clean = developed("--until", "quantize", "--skip", "noise")
    report = measured(f"{noisy}.exr", "--truth", f"{clean}.exr")
    for one in report["channels"].values():
        assert one["row"]["sigma"] == pytest.approx(0.004, rel=0.1)
        assert one["row"]["limit"] < 0.003
    across = report["correlation"]
    assert across["R-G1"] > 0.1 > 0.05 > abs(across["R-B"])
    assert across["G2-B"] > 0.1 > 0.05 > abs(across["G1-G2"])
    whole = report["channels"]["mosaic"]["autocorrelation"]
    assert whole[8][9] > 0.1 > 0.05 > abs(whole[9][8])


@pytest.mark.slow
def test_repeats_measure_what_the_truth_does(developed, measured):
    names = [developed("--until", "normalize", "--seed", str(seed)) + ".exr" for seed in range(6)]
    clean = developed("--until", "normalize", "--skip", "noise")
    repeats, against = measured(*names), measured(*names, "--truth", f"{clean}.exr")
    assert repeats["truth"] is None
    for name, one in repeats["channels"].items():
        other = against["channels"][name]
        assert one["sigma"] == pytest.approx(other["sigma"], rel=0.01)
        assert one["law"]["a"] == pytest.approx(other["law"]["a"], rel=0.02)
        assert one["law"]["b"] == pytest.approx(other["law"]["b"], rel=0.12)
        assert abs(one["energy_left_2x2"] - 0.25) < 0.01
    pair = measured(*names[:2])
    assert pair["channels"]["G1"]["sigma"] == pytest.approx(
        against["channels"]["G1"]["sigma"], rel=0.01
    )
    assert "two frames" in " ".join(pair["notes"])


@pytest.mark.slow
def test_processing_correlates_noise(developed, measured):
    formats = ("--format", "jpg", "--format", "png", "--format", "exr", "--keep", "demosaic")
    noisy = developed(*formats)
    clean = developed(*formats, "--skip", "noise", "--skip", "denoise")
    reports = {
        ending: measured(f"{noisy}.{ending}", "--truth", f"{clean}.{ending}")
        for ending in ("jpg", "png", "exr", "demosaic.exr")
    }
    for ending, report in reports.items():
        channels = report["channels"]
        assert list(channels) == ["R", "G", "B", "Y", "Cb", "Cr"]
        assert 0.2 < report["share_used"] < 0.6
        linear = ending == "demosaic.exr"
        least = 0.55 if linear else 0.7  # denoising correlates chroma further
        left = {name: each["energy_left_2x2"] for name, each in channels.items()}
        assert min(left["Cb"], left["Cr"]) > least > left["Y"] + 0.05
        assert channels["Cr"]["autocorrelation"][8][9] > least
        assert report["correlation"]["R-G"] > 0.3
        assert report["kind"] == ("rgb" if linear else "display")
        assert (channels["G"]["law"] is not None) == linear
        assert channels["Y"]["law"] is None
    # Eight bits hide little of this noise; JPEG at quality 97 neither.
    sigma = {ending: report["channels"]["Y"]["sigma"] for ending, report in reports.items()}
    assert sigma["png"] == pytest.approx(sigma["exr"], rel=0.1)
    assert sigma["jpg"] == pytest.approx(sigma["png"], rel=0.15)


@pytest.mark.slow
def test_the_tables_and_the_picture(developed, clpipe, tmp_path):
    noisy = developed("--until", "quantize")
    clean = developed("--until", "quantize", "--skip", "noise")
    text = clpipe(
        "measure", f"{noisy}.exr", "--truth", f"{clean}.exr", "--plot", "plots/noise.png"
    ).stdout
    for part in ("variance = a * intensity + b", "left after 2x2", "R-G1", "Gaussian", "99."):
        assert part in text
    with Image.open("plots/noise.png") as picture:
        assert picture.size[0] == 1600
        colours = picture.convert("RGB").getcolors(1 << 20)
        assert len(colours) > 500
    result = clpipe(
        "measure", f"{noisy}.exr", "--truth", f"{clean}.exr", "--plot", "a.jpg", status=2
    )
    assert "ends in .png" in result.stderr


def png(path, pixels):
    Image.fromarray(pixels).save(path)
    return path


def test_finished_pictures_of_sixteen_bits(tmp_path, measured):
    random = np.random.default_rng(2)
    clean = np.tile(np.linspace(40, 200, 256), (256, 1))[..., None].repeat(3, -1)
    noisy = clean + random.normal(0, (4, 6, 8), clean.shape)
    paths = [tmp_path / "noisy.tif", tmp_path / "clean.tif"]
    for path, pixels in zip(paths, (noisy, clean), strict=True):
        oiio.ImageBuf((pixels * 257).astype(np.uint16)).write(str(path))
    report = measured(paths[0], "--truth", paths[1])
    found = [report["channels"][name]["sigma"] * 255 for name in "RGB"]
    assert found == pytest.approx([4, 6, 8], rel=0.01)
    assert report["share_used"] > 0.95


def test_the_whole_picture_and_the_covariance_of_channels(tmp_path, measured, clpipe):
    """Noise is twice as large next to edges; channels share a part of it."""
    random = np.random.default_rng(5)
    clean = np.full((256, 257, 3), 128.0)
    clean[:128, ::2] -= 40  # stripes: nowhere flat
    noise = random.normal(0, 4, clean.shape) + random.normal(0, 3, clean.shape[:2])[..., None]
    noise[:128] *= 2
    paths = [
        png(tmp_path / f"{name}.png", (clean + part).round().astype(np.uint8))
        for name, part in (("noisy", noise), ("clean", 0))
    ]
    report = measured(paths[0], "--truth", paths[1])
    assert 0.45 < report["share_used"] < 0.5
    tables = {name: np.array(table) * 255**2 for name, table in report["covariance"].items()}
    shared = np.full((3, 3), 9.0) + 16 * np.eye(3)
    assert tables["flat"] == pytest.approx(shared, rel=0.05)
    assert tables["picture"] == pytest.approx(2.5 * shared, rel=0.05)
    assert tables["halved"] == pytest.approx(2.5 / 4 * shared, rel=0.05)
    for i, name in enumerate("RGB"):
        one = report["channels"][name]
        assert one["sigma"] ** 2 == pytest.approx(report["covariance"]["flat"][i][i])
        assert one["sigma_picture"] ** 2 == pytest.approx(report["covariance"]["picture"][i][i])
        curve = one["intensity_picture"]
        variance = np.average(np.square(curve["sigma"]), weights=curve["samples"])
        assert variance * 255**2 == pytest.approx(2.5 * 25, rel=0.05)
    cb = 0.564 * (noise[..., 2] - noise @ (0.299, 0.587, 0.114))
    assert report["channels"]["Cb"]["sigma_picture"] * 255 == pytest.approx(cb.std(), rel=0.02)
    text = clpipe("measure", paths[0], "--truth", paths[1]).stdout
    assert re.search(r"sigma \(flat, 4\d%\) +sigma \(all, 100%\)", text)
    assert re.search(r"^all, after 2x2 +0\.0", text, re.MULTILINE)


def test_skew_chroma_and_saturated_colours_of_finished_pictures(tmp_path, measured, clpipe):
    """Below luma 64 chroma noise is half as strong. Above 112 luma noise has a part of skew -1."""
    random = np.random.default_rng(6)
    clean = np.tile(np.linspace(26, 158, 512), (256, 1))[..., None].repeat(3, -1)
    level = clean[..., 0]
    noise = random.normal(0, 4, clean.shape) * np.where(level < 64, 0.5, 1)[..., None]
    gamma = 3 * (4 - random.gamma(4, 1, level.shape))  # sigma 6, skew -1
    noise += np.where(level < 112, 0, gamma)[..., None]
    clean[:100] = 110, 25, 40
    noise[:100] = random.normal(0, 6, noise[:100].shape) * (1, 0.5, 1)
    noisy = png(tmp_path / "noisy.png", (clean + noise).round().clip(0, 255).astype(np.uint8))
    truth = png(tmp_path / "clean.png", clean.round().astype(np.uint8))
    found = measured(noisy, "--truth", truth)["finished"]
    share = 36 / (36 + 16 * (0.299**2 + 0.587**2 + 0.114**2))  # of skewed noise in luma's variance
    assert found["skew_80"] == pytest.approx(0, abs=0.08)
    assert found["skew_112"] == pytest.approx(-(share**1.5), abs=0.1)
    assert found["skew_160"] is None and found["chroma_sigma_192"] is None
    assert found["chroma_sigma_24"] == pytest.approx(0.5, abs=0.03)
    assert found["chroma_sigma_128"] == pytest.approx(1, abs=0.05)
    assert found["weak_over_strong"] == pytest.approx(0.5, abs=0.03)
    text = clpipe("measure", noisy, "--truth", truth).stdout
    here = f"{found['chroma_sigma_128']:.2f}"
    row = rf"^chroma rms at 128-159 over that at 64-95 +{here} +0\.83 to 1\.11"
    assert re.search(row, text, re.MULTILINE)
    assert "luma skew at 160-219" not in text


def test_these_figures_against_the_mean_and_without_scipy(tmp_path, measured, clpipe, monkeypatch):
    for folder, seed in (("a", 3), ("b", 4)):
        burst(tmp_path / folder, "{}.png", seed, 5)
    one, two, both = (
        measured(*(tmp_path / name for name in names))["finished"] for names in ("a", "b", "ab")
    )
    name = "chroma_sigma_96"
    assert one[name] == pytest.approx(1, abs=0.1)
    assert both[name] == pytest.approx((one[name] + two[name]) / 2)
    monkeypatch.setattr("clpipe.analysis.measure.is_installed", lambda _: False)
    text = clpipe("measure", tmp_path / "a").stdout
    assert "because scipy is missing. Run: pip install scipy" in text
    assert "luma skew" not in text and "chroma rms" not in text


def scene_of(seed, height=96):
    tiles = np.random.default_rng(seed).uniform(60, 190, (height // 32, 4))
    return np.kron(tiles, np.ones((32, 32)))[..., None].repeat(3, -1)


def burst(folder, name, seed, sigma, iso=None, height=96):
    random, exif = np.random.default_rng(seed + 10), Image.Exif()
    if iso:
        exif[0x8769] = {0x8827: iso}
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(3):
        noisy = scene_of(seed, height) + random.normal(0, sigma, (height, 128, 3))
        picture = Image.fromarray(noisy.round().astype(np.uint8))
        picture.save(folder / name.format(k), exif=exif)


@pytest.mark.slow
def test_bursts_of_several_scenes_are_one_figure_for_each_iso(tmp_path, measured, clpipe):
    out = tmp_path / "out"
    burst(out / "low", "one.frame{}.png", 1, 3, 100)
    burst(out / "low", "two.frame{}.png", 2, 6, 100, height=192)
    burst(out / "high", "one.frame{}.png", 1, 9, 800)
    png(out / "high" / "one.truth.png", scene_of(1).astype(np.uint8))
    by_iso = measured(out)["by_iso"]
    assert [(iso, one["bursts"], len(one["images"])) for iso, one in by_iso.items()] == [
        ("100", 2, 6),
        ("800", 1, 3),
    ]
    for iso, variance_expected in (("100", (3**2 + 2 * 6**2) / 3), ("800", 9**2)):
        report = by_iso[iso]
        one = report["channels"]["G"]
        for found in (one["sigma_picture"] ** 2, report["covariance"]["picture"][1][1]):
            assert found * 255**2 == pytest.approx(variance_expected, rel=0.05)
        assert report["covariance"]["halved"][2][2] * 255**2 == pytest.approx(
            variance_expected / 4, rel=0.06
        )
        curve = one["intensity_picture"]
        variance = np.average(np.square(curve["sigma"]), weights=curve["samples"])
        assert variance * 255**2 == pytest.approx(variance_expected, rel=0.05)
        assert one["energy_left_2x2"] == pytest.approx(0.25, abs=0.02)
        assert sum(one["histogram"]["samples"]) == one["samples"]
    low = measured(*sorted((out / "low").glob("*.frame?.png")))
    assert low == by_iso["100"] | {"images": low["images"], "format": 1}
    text = clpipe("measure", out).stdout
    assert "6 x display in 2 bursts, 128x96, ISO 100, against the mean of their burst" in text
    assert "3 x display, 128x96, ISO 800, against their mean" in text


@pytest.mark.slow
def test_a_raws_law_is_pooled_by_its_errors():
    random, a, b, reports = np.random.default_rng(7), 6e-4, 1e-4, []
    for size in (200, 800):
        clean = np.tile(np.linspace(0, 0.8, size, dtype=np.float32), (size, 1))
        frames = [
            clean + random.standard_normal(clean.shape, np.float32) * np.sqrt(a * clean + b)
            for _ in range(2)
        ]
        reports.append(
            measure([Picture(Path("n"), "mosaic", frame, white=1.0) for frame in frames])
        )
    (pooled,) = pool_by_iso(reports)
    laws = [report.channels[-1].law for report in (*reports, pooled)]
    assert abs(laws[2].a - a) < 3 * laws[2].a_error and abs(laws[2].b - b) < 3 * laws[2].b_error
    assert laws[2].a_error < min(laws[0].a_error, laws[1].a_error)
    assert laws[2].a_error > 0.8 * laws[1].a_error
    assert pooled.channels[-1].row.limit < reports[0].channels[-1].row.limit


def test_folders_of_photographs_are_a_burst_each(tmp_path, measured, clpipe):
    photos = tmp_path / "photos"
    burst(photos / "a", "DSC{}.jpg", 3, 5)
    burst(photos / "b", "DSC{}.jpg", 4, 5)
    assert measured(photos / "a", photos / "b")["bursts"] == 2
    files = sorted(photos.rglob("*.jpg"))
    assert "does not" in clpipe("measure", *files, status=2).stderr
    burst(photos / "b", "x.frame{}.png", 4, 5)
    burst(photos / "b", "x.frame{}.jpg", 4, 5)
    (tmp_path / "empty").mkdir()
    for arguments, message in (
        ([photos / "b"], "this folder has frames with the extensions .jpg and .png; choose one"),
        ([tmp_path / "empty"], "empty: this folder has no pictures (.jpg, "),
        (
            [photos / "a", files[3], files[4], "--truth", files[0]],
            "found 2 bursts, but one ground truth",
        ),
    ):
        assert message in clpipe("measure", *arguments, status=2).stderr


def test_a_mosaic_that_says_nothing_is_taken_as_it_is(write_exr, measured):
    random = np.random.default_rng(3)
    scene = np.tile(np.linspace(600, 3000, 200), (200, 1))
    scene[::2, ::2] *= 0.5  # blue stands first in BGGR
    frames = [
        write_exr(
            f"{i}.exr", (scene + random.normal(0, 20, scene.shape))[..., None], "Y", half=False
        )
        for i in range(3)
    ]
    report = measured(*frames, "--pattern", "BGGR")
    assert report["kind"] == "values"
    channels = report["channels"]
    assert channels["mosaic"]["sigma"] == pytest.approx(20, rel=0.02)
    assert max(channels["B"]["intensity"]["mean"]) < 1600 < max(channels["R"]["intensity"]["mean"])


@pytest.mark.slow
def test_no_noise_is_said_not_divided_by(clpipe, tmp_path, measured):
    clean = png(tmp_path / "clean.png", scene_of(8).astype(np.uint8)).with_suffix("")
    report = measured(f"{clean}.png", "--truth", f"{clean}.png")
    assert "identical" in " ".join(report["notes"])
    for one in report["channels"].values():
        assert one["sigma"] == 0
        assert one["energy_left_2x2"] is None
    text = clpipe("measure", f"{clean}.png", f"{clean}.png", "--plot", "flat.png").stdout
    assert "identical" in text


def test_refusals(clpipe, tmp_path, write_exr):
    half = np.full((20, 30, 3), 128, np.uint8)
    one = png(tmp_path / "one.png", half)
    small = png(tmp_path / "small.png", half[:10])
    white = png(tmp_path / "white.png", half | 255)
    linear = write_exr("linear.exr", half / np.float32(255))
    mosaic = write_exr("mosaic.exr", np.full((20, 30, 1), 0.5, np.float32), "Y")
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"\xff\xd8\xff\xe0" + b"no" * 99)
    for arguments, status, message in (
        ((one,), 2, "there is nothing to measure this image against"),
        ((one, small), 2, "small.png is display, 30x10, but .*one.png is display, 30x20"),
        ((one, "--truth", small), 2, "small.png is display, 30x10"),
        ((one, linear), 2, "linear.exr is rgb, 30x20"),
        ((one, "--truth", mosaic), 2, "mosaic without known levels RGGB"),
        (
            (white, white),
            1,
            "white.png: there is nothing to measure: all samples, or their noise, are clipped",
        ),
        ((one, tmp_path / "missing.png"), 2, "missing.png: there is no such file"),
        ((broken, broken), 1, "broken.jpg: "),
        ((one, one, "--pattern", "XYZ"), 2, "RGGB"),
    ):
        result = clpipe("measure", *arguments, status=status)
        assert re.search(message, result.stderr), result.stderr
        assert "Traceback" not in result.stderr


def test_settings_that_cannot_be_used(write_exr, clpipe, tmp_path):
    clpipe("run", STILL_LIFE, "-o", "a", "--until", "quantize")
    file = oiio.ImageInput.open("a/still_life.exr")
    spec, pixels = file.spec(), file.read_image(oiio.FLOAT)
    file.close()
    spec.attribute("clpipe:settings", '{"camera": "box"}')
    out = oiio.ImageOutput.create("bad.exr")
    out.open("bad.exr", spec)
    out.write_image(pixels)
    out.close()
    result = clpipe("measure", "bad.exr", "bad.exr", status=1)
    assert "bad.exr: the settings in this file are invalid: unknown camera 'box'" in result.stderr


def test_odd_and_tiny_mosaics():
    random = np.random.default_rng(4)
    for shape in ((2, 2), (3, 5), (31, 47)):
        frames = [
            Picture(Path(str(i)), "values", random.random(shape, np.float32)) for i in range(3)
        ]
        try:
            report = measure(frames)
        except Exception as error:
            assert "nothing to measure" in str(error)  # of four pixels the extremes are two
            assert max(shape) < 10
            continue
        json.dumps(report.record(), allow_nan=False)
        assert measure_tables(report)


@pytest.mark.slow
def test_load_says_what_it_read(clpipe, tmp_path):
    kinds = {"mosaic": "mosaic", "quantize": "mosaic", "demosaic": "rgb", "gamma": "display"}
    keep = [word for stage in kinds for word in ("--keep", stage)]
    clpipe("run", STILL_LIFE, "-o", "a", *keep, "--set", "mosaic.pattern=GBRG")
    for stage, kind in kinds.items():
        picture = load_picture(tmp_path / f"a/still_life.{stage}.exr")
        assert picture.kind == kind
        assert picture.pattern == ("GBRG" if kind == "mosaic" else "RGGB")
        assert picture.black == {"mosaic": None}.get(stage, picture.black)
    raw = load_picture(tmp_path / "a/still_life.quantize.exr")
    assert raw.black == pytest.approx(-512 / 15871)
    assert raw.pixels.max() <= 1


def test_wrong_partners_are_refused(developed, clpipe):
    noisy = developed("--until", "quantize", "--iso", "800")
    other = developed("--until", "quantize", "--seed", "1", "--iso", "1600")
    before = developed("--until", "mosaic")
    found = clpipe("measure", f"{noisy}.exr", f"{other}.exr", status=2)
    assert "give images of one ISO" in found.stderr
    found = clpipe("measure", f"{noisy}.exr", "--truth", f"{before}.exr", status=2)
    assert "keep both images after the same stage" in found.stderr


def test_a_truth_among_the_repeats_is_refused(clpipe, tmp_path):
    clpipe("run", STILL_LIFE, "-o", "burst", "--iso", 3200, "--frames", 3, "--until", "quantize")
    images = sorted((tmp_path / "burst").glob("*.exr"))
    assert len(images) == 4
    found = clpipe("measure", *images, status=2)
    assert "truth.exr has 0." in found.stderr and "pass it with --truth" in found.stderr


def test_another_scene_among_the_repeats_is_refused():
    random, height, width = np.random.default_rng(2), 256, 384
    y, x = np.mgrid[:height, :width] / 64
    scene = (0.3 + 0.15 * np.sin(x) * np.cos(y + x * x / 9)).astype(np.float32)
    fixed = random.normal(0, 0.1, scene.shape)

    def frame(name, light, sigma):
        rows = random.normal(0, sigma, (height, 1))  # stronger than any camera's
        noise = random.normal(0, sigma, scene.shape) + rows + fixed
        return Picture(Path(name), "mosaic", (light + noise).astype(np.float32))

    for sigma in (0.001, 0.03):
        repeats = [frame(f"{k}.exr", scene, sigma) for k in range(3)]
        assert len(measure(repeats).images) == 3
        for other in (frame("other.exr", scene[:, ::-1], sigma), frame("other.exr", 0.3, sigma)):
            with pytest.raises(RequestError, match=r"^other\.exr does not show .* as the others"):
                measure([*repeats, other])
            with pytest.raises(RequestError, match=r"does not show the same scene as"):
                measure([repeats[0], other])


@pytest.mark.slow
def test_a_shift_by_a_pixel_is_refused_and_strong_noise_is_not(developed, tmp_path):
    name = developed("--iso", 12800, "--frames", 3, "--format", "png")
    frames = [load_picture(tmp_path / f"{name}.frame{k}.png") for k in range(3)]
    assert measure(frames) and frames[0].iso == 12800
    moved = replace(frames[1], path=Path("moved.png"), pixels=np.roll(frames[1].pixels, 1, 1))
    with pytest.raises(RequestError, match=r"^moved\.png is not aligned with the others: "):
        measure([frames[0], moved, frames[2]])
    with pytest.raises(RequestError, match=r"^moved\.png is not aligned with \S+frame0\.png: "):
        measure([frames[0], moved])


@pytest.mark.slow
def test_a_frame_and_the_mean_of_others_are_repeats(developed):
    """Correlated noise, like that of a camera's JPEGs, is not mistaken for another scene."""
    look = ("-c", "nikon-d800-jpeg")
    name = developed(*look, "--frames", 4, "--format", "jpg")
    first, *others = (load_picture(Path(f"{name}.frame{k}.jpg")) for k in range(4))
    mean = np.mean([frame.pixels for frame in others], axis=0, dtype=np.float32)
    clean = load_picture(Path(developed(*look, "--skip", "noise", "--format", "png") + ".png"))
    repeats = measure([first, replace(first, path=Path("mean.png"), pixels=mean)])
    assert (
        repeats.share_used > measure([first], clean).share_used / 2
    )  # places that noise leaves flat


@pytest.mark.slow
def test_repeats_of_real_cameras_are_repeats(shared_data):
    for name in ("5dmark3_iso3200_1", "d800_iso1600_1"):
        paths = (shared_data / "real_noise" / f"{name}_{end}.png" for end in ("real", "mean"))
        assert measure([load_picture(path) for path in paths]).share_used > 0.2
