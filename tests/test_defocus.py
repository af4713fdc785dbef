"""defocus: depth of field from a depth channel, checked against geometry."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

import clpipe as clpipe_api
from clpipe.base.errors import ImageError
from clpipe.chain.layers import layer_of_array, with_layers
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from tests.conftest import written
from tests.test_cuts import in_tiles

# The disc of a point that is infinitely far: 100^2 / (4 (2000 - 100)) mm = 131.6 px of 10 um.
LENS = {"focal_length": 100.0, "f_number": 4.0, "focus_distance": 2.0, "pixel_pitch": 10.0}
FAR = 100**2 / (4 * 1900) / 0.01
SETS = [x for k, v in LENS.items() for x in ("--set", f"defocus.{k}={v}")]
SCENE = Path(__file__).parent / "data" / "defocus"
RUN = ("--stages", "defocus", "--format", "exr", "--device", "numpy")
THIN = ("--set", "defocus.method=thin_lens", *SETS)


def at_radius(radius):
    """Return the distance beyond the focus at which discs have a radius in px."""
    return 2.0 / (1 - 2 * radius / FAR)


def runner_for(image, depth, device, **lens):
    lens = {"method": "thin_lens", **LENS, **lens}
    chain = make_chain(settings_from({"stages": ["defocus"], "defocus": lens}))
    held = {"defocus": layer_of_array(chain, "defocus", np.float32(depth), *image.shape[1::-1])}
    return Runner(with_layers(chain, held), device, encode=False, final=True), held


def blurred(image, depth, device, **lens):
    runner, _held = runner_for(image, depth, device, **lens)
    return runner.run(image, "k").final


def scene(height, width, seed=0):
    """Random light at random distances on both sides of the focus, a sky, and what is sharp."""
    rng = np.random.default_rng(seed)
    depth = rng.choice(np.float32([1.9, 2.0, 2.1, 2.2, np.inf]), (height, width))
    return rng.random((height, width, 3), np.float32), depth


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (11, 1), (2, 3), (37, 53), (9, 530)])
@pytest.mark.parametrize("blades", [0, 7])
def test_the_kernel_is_the_reference(device, scalar_device, size, blades):
    image, depth = scene(*size)
    expected = blurred(image, depth, None, max_radius=5, blades=blades)
    for on in (device, scalar_device):
        assert blurred(image, depth, on, max_radius=5, blades=blades) == pytest.approx(
            expected, abs=1e-5
        )


def test_tiles_have_the_same_bits(device):
    image, depth = scene(150, 203)
    runner, _held = runner_for(image, depth, device, max_radius=5)
    assert in_tiles(runner, image, 70, 56)[1] >= 6


@pytest.mark.parametrize("distance", [at_radius(2.5), at_radius(7.2), at_radius(-9.0), 2.0])
def test_a_point_is_a_disc_of_the_diameter_that_the_lens_says(device, distance):
    image = np.zeros((65, 65, 3), np.float32)
    image[32, 32] = 1
    seen = blurred(image, np.full((65, 65), distance), device)[..., 1].astype(np.float64)
    assert seen.sum() == pytest.approx(1, abs=1e-4)
    diameter = 100**2 * abs(distance - 2) / (4 * distance * 1900) / 0.01
    y, x = np.mgrid[-32:33, -32:33]
    # The mean square distance from the middle of an even disc is diameter^2 / 8.
    found = np.sqrt(8 * (seen * (x**2 + y**2)).sum())
    assert found == pytest.approx(diameter, abs=0.3)


def test_blades_cut_the_disc(device):
    image = np.zeros((65, 65, 3), np.float32)
    image[32, 32] = 1
    depth = np.full((65, 65), at_radius(12))
    round_, cut = (blurred(image, depth, device, blades=n)[..., 0] > 0.001 for n in (0, 6))
    # A hexagon's area is 3 sqrt(3) / 2 times its corners' radius squared.
    assert cut.sum() / round_.sum() == pytest.approx(3 * 3**0.5 / 2 / np.pi, abs=0.03)
    assert not (cut & ~round_).any()


def test_a_sharp_foreground_keeps_its_edge_and_gives_no_light_away(device):
    image = np.full((48, 80, 3), 0.1, np.float32)
    image[:, :40] = 1
    depth = np.full((48, 80), at_radius(8))
    depth[:, :40] = 2.0
    assert blurred(image, depth, device) == pytest.approx(image, abs=1e-6)
    # A foreground out of focus spreads over the sharp background.
    depth[:, :40], depth[:, 40:] = at_radius(-8), 2.0
    seen = blurred(image, depth, device)[24, :, 0]
    assert seen[42] > 0.2
    assert seen[50] == pytest.approx(0.1)


def channels(name):
    """The channels of an EXR of the scene that tests/data/defocus/make.py renders."""
    with OpenEXR.File(str(SCENE / name), separate_channels=True) as file:
        return {k: c.pixels.astype(np.float32) for k, c in file.channels().items()}


def rms(x, where):
    return float(np.sqrt((x[where] ** 2).mean()))


def test_a_foreground_out_of_focus_lets_the_background_through_as_in_cycles(device):
    pinhole, truth = (
        (found := channels(name), np.stack([found[k] for k in "RGB"], -1))
        for name in ("pinhole.exr", "thin_lens.exr")
    )
    depth = pinhole[0]["Z"]
    lens = {"focal_length": 50.0, "f_number": 0.5, "focus_distance": 3.0, "pixel_pitch": 150.0}
    seen, truth = blurred(pinhole[1], depth, device, **lens), truth[1]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(depth, 12, "edge"), (25, 25))
    edges = windows.max((2, 3)) > 1.05 * windows.min((2, 3))
    # What is left is Cycles' noise, and around edges what the render does not show: 0.087 without
    # a lens, 0.049 where foregrounds kept their edges.
    assert rms(seen - truth, ~edges) < 0.0015
    assert rms(seen - truth, edges) < 0.016
    assert seen.sum() == pytest.approx(truth.sum(), rel=0.001)
    assert seen[edges].sum() == pytest.approx(truth[edges].sum(), rel=0.002)


@pytest.mark.parametrize(("near", "far"), [(-8, 0), (-12, -2), (3, 9), (-8, 4), (0, 8)])
def test_an_edge_is_as_wide_as_its_disc_on_both_sides(device, near, far):
    image = np.full((41, 80, 3), 0.25, np.float32)
    image[:, :40] = 1
    depth = np.full(image.shape[:2], at_radius(far) if far else 2.0)
    depth[:, :40] = at_radius(near) if near else 2.0
    seen = blurred(image, depth, device)[20, :, 0]
    # How much of a disc lies left of the edge, which stands between two pixels.
    x = np.clip((39.5 - np.arange(80)) / max(abs(near), 0.5), -1, 1)
    covered = 0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi
    assert seen == pytest.approx(0.25 + 0.75 * covered, abs=0.02)


@pytest.fixture
def render(tmp_path, monkeypatch):
    """Write a render, or a companion, of these channels in the working directory."""
    monkeypatch.chdir(tmp_path)

    def write(name, **channels):
        kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(
            kind, {k: np.ascontiguousarray(v, np.float32) for k, v in channels.items()}
        ).write(name)

    return write


def colours(image):
    return dict(zip("RGB", np.moveaxis(image, 2, 0), strict=True))


def test_depth_of_the_file_or_a_companion(render, clpipe):
    image, depth = scene(9, 14)
    depth[0, :2] = 0, 1e10  # nothing there, to Mitsuba and to Blender
    depth[1, :2] = np.inf
    render("a.exr", **colours(image), **{"View.Depth.Z": depth})
    expected = blurred(image, depth, None)
    made = clpipe("run", "a.exr", "-o", "o", *RUN, *THIN)
    assert read_image(Path("o/a.exr")).pixels == pytest.approx(expected, abs=1e-3)
    assert "pixels have discs with radii up to 65.8 px" in made.output
    record = json.loads(Path("o/a.json").read_text())
    assert record["depth"][0].items() >= {"layer": "Depth", "file": "a.exr"}.items()
    render("b.exr", **colours(image))
    render("b_depth.exr", Z=depth)
    clpipe("run", "b.exr", "-o", "o", *RUN, *THIN)
    assert np.array_equal(read_image(Path("o/b.exr")).pixels, read_image(Path("o/a.exr")).pixels)
    assert written(Path("o")) == ["a.exr", "a.json", "b.exr", "b.json"]
    assert "(it was there" in clpipe("run", "b.exr", "-o", "o", *RUN, *THIN).output
    render("b_depth.exr", Z=np.full((9, 14), 2.0))
    assert "(it was there" not in clpipe("run", "b.exr", "-o", "o", *RUN, *THIN).output
    assert read_image(Path("o/b.exr")).pixels == pytest.approx(image, abs=1e-3)


@pytest.mark.parametrize(
    ("depth", "options", "message"),
    [
        (None, (), "defocus needs depth: there is no layer 'Depth'"),
        (np.full((9, 14), 2), ("--set", 'defocus.layer="Far"'), "no layer 'Far'"),
        (np.full((9, 13), 2), (), "has 13x9 pixels, but the picture a.exr has 14x9"),
        ([[2, 2, -1, np.nan] + [2] * 10] * 9, (), "in 18 pixels, first -1 at column 2, row 0"),
    ],
)
def test_depth_that_cannot_be_used(render, clpipe, depth, options, message):
    render("a.exr", **colours(scene(9, 14)[0]))
    if depth is not None:
        render("a_depth.exr", Z=depth)
    failed = clpipe("run", "a.exr", "-o", "o", *RUN, *THIN, *options, status=1)
    assert message in " ".join(failed.output.split())


def test_in_python():
    image, depth = scene(9, 14)
    width = 14 * 10 / 1000
    own = {k: v for k, v in LENS.items() if k != "pixel_pitch"}
    settings = {"stages": ["defocus"], "defocus": {"method": "thin_lens", **own}}
    settings["defocus"]["sensor_width"] = width
    pipeline = clpipe_api.Pipeline(**settings, device="numpy")
    with pytest.warns(UserWarning, match="discs with radii"):
        seen = pipeline.process(image, "a", depth=depth).image
    assert seen == pytest.approx(blurred(image, depth, None), abs=1e-6)
    with pytest.raises(ImageError, match="needs depth"):
        pipeline.process(image, "a")
    with pytest.raises(ImageError, match=r"shape \(9, 13\)"):
        pipeline.process(image, "a", depth=depth[:, 1:])


METERED = {
    "iso": 800,
    "stages": ["exposure", "defocus", "mosaic", "white_balance", "demosaic"],
    "exposure": {"method": "auto"},
    "defocus": {"method": "thin_lens", "max_radius": 3, **LENS},
    "white_balance": {"method": "gray_world"},
    "device": "numpy",
}


def test_frames_that_are_metered_keep_their_depth(render):
    """White balance is metered from frames that the lens has blurred."""
    image, depth = scene(9, 14)
    Path("frames").mkdir()
    for number in range(3):
        render(f"frames/{number}.exr", **colours(image), Z=depth)
    files = {"format": "exr", "sequence": True}
    outcomes = list(clpipe_api.run("frames", "out", **METERED, **files))
    assert [outcome.status for outcome in outcomes] == ["done"] * 3
    values = [outcome.job.values for outcome in outcomes]
    with clpipe_api.Stream(**METERED) as stream, pytest.warns(UserWarning, match="radii"):
        shots = [stream(image, depth) for _ in range(3)]
    for number, (shot, frame) in enumerate(zip(shots, values, strict=True)):
        assert shot.settings == frame
        made = read_image(Path(f"out/{number}.exr")).pixels
        assert made == pytest.approx(shot.image, abs=2e-3)
