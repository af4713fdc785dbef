"""Configurations on top of others: the raw of one, the development of the next."""

import json

import numpy as np
import pytest
from PIL import Image

import clpipe as api
from clpipe.base.errors import RequestError
from clpipe.chain.files import load_config, load_configs, load_settings
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.images.read import read_image
from tests.conftest import cli_output as clpipe

LOOK = "nikon-d800-jpeg"
NUMPY = ("--device", "numpy")

WAY = """
stages = [
    "denoise", "exposure", "mosaic", "sensor_noise", "quantize", "normalize", "demosaic", "gamma",
]
skip = ["demosaic"]
seed = 3
[denoise]
method = "median"
[exposure]
ev = -1
[sensor_noise]
b = 1e-6
[gamma]
method = "power"
"""
DEVELOPMENT = """
iso = 800
stages = [
    "mosaic", "defect_pixels", "sensor_noise", "quantize",
    "normalize", "demosaic", "denoise", "denoise", "sharpen", "gamma",
]
skip = ["denoise_2", "defect_pixels"]
[sensor_noise]
a = 1e-3
[demosaic]
method = "bilinear"
[denoise]
method = "bilateral"
luma_strength = { uniform = [0.1, 0.2] }
[sharpen]
amount = { same_as = "denoise.luma_strength" }
"""


@pytest.fixture
def two(tmp_path):
    (tmp_path / "way.toml").write_text(WAY)
    (tmp_path / "look.toml").write_text(DEVELOPMENT)
    return str(tmp_path / "way.toml"), str(tmp_path / "look.toml")


def test_the_steps_behind_the_raw_are_the_second_ones(two):
    found = load_configs(two)
    settings = found.settings
    raw = ("denoise", "exposure", "mosaic", "sensor_noise", "quantize")
    own = ("normalize", "demosaic", "denoise", "denoise", "sharpen", "gamma")
    assert settings.stages == (*raw, *own)
    assert settings.skip == ("denoise_3",)
    assert (settings.seed, settings.iso) == (3, 800)
    assert settings.parameters == {
        "denoise": {"method": "median"},
        "exposure": {"ev": -1},
        "sensor_noise": {"b": 1e-6},
        "demosaic": {"method": "bilinear"},
        "denoise_2": {"method": "bilateral"},
        "sharpen": {},
    }
    chain = make_chain(settings.drawn("a"))
    strength = chain.step_named("denoise_2").method.luma_strength
    assert 0.1 <= strength == chain.step_named("sharpen").method.amount
    assert chain.step_named("gamma").method.method != "power"


def test_each_configuration_alone_is_what_it_was(two):
    for name in (*two, LOOK, "unprocess"):
        assert load_configs([name]) == load_config(name)
        assert load_settings(name) == settings_from(load_config(name).values)
    assert load_settings() == settings_from({})


@pytest.mark.parametrize("before", [(), ("unprocess",), ("nikon-d800-jpeg",)])
def test_training_develops_each_picture_in_another_way(before):
    settings = load_configs([*before, "training"]).settings
    drawn = [settings.drawn(f"{n}.exr") for n in range(200)]
    methods = [{s.name: s.method for s in make_chain(one).steps} for one in drawn[:40]]
    for step, name, low, high in (
        ("denoise", "luma_strength", 0.2, 4),
        ("denoise", "chroma_strength", 0.05, 0.5),
        ("denoise", "grain", 0.05, 0.4),
    ):
        values = [getattr(method[step], name) for method in methods]
        assert low <= min(values) < low * 2 and high / 1.5 < max(values) <= high
    assert 700 <= min(one.iso for one in drawn) < 1100
    assert 5000 < max(one.iso for one in drawn) <= 6400


@pytest.mark.parametrize("names", [("unprocess", LOOK), ("paper", "brooks2019", "canon-5d2-jpeg")])
def test_its_values_make_the_same_settings_again(two, names):
    for each in (names, two, (*two, "paper")):
        found = load_configs(each)
        assert settings_from(found.values) == found.settings
        make_chain(found.settings)


def test_one_without_stages_is_laid_over_as_options_are(tmp_path):
    (tmp_path / "a.toml").write_text("skip = ['row_noise']\n[denoise]\nluma_strength = 0.5\n")
    found = load_settings(LOOK, str(tmp_path / "a.toml"))
    before = load_settings(LOOK)
    assert found.stages == before.stages
    assert found.skip == ("row_noise",)
    assert found.parameters["denoise"] == {**before.parameters["denoise"], "luma_strength": 0.5}
    assert found.parameters["sharpen"] == before.parameters["sharpen"]


@pytest.mark.parametrize("names", [("unprocess", "syb3r"), ("syb3r", LOOK)])
def test_a_chain_without_a_raw_is_named(names):
    with pytest.raises(
        RequestError, match=rf"{names[1]} over {names[0]}: stages: found exposure, m"
    ):
        load_configs(names)
    output = clpipe("plan", *(o for name in names for o in ("-c", name)), status=2)
    assert "but none of these stages produces a raw" in output


@pytest.fixture
def photograph(tmp_path):
    y, x = np.mgrid[0:24, 0:30]
    picture = np.stack([60 + 4 * x, 90 + 3 * y, 150 - 2 * x], axis=-1).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "a.png")
    return tmp_path / "a.png"


@pytest.fixture
def render(write_exr):
    return write_exr("a.exr", np.random.default_rng(0).random((24, 30, 3), np.float32))


def picture(path):
    with Image.open(path) as image:
        return np.asarray(image)


@pytest.mark.parametrize(("way", "kind"), [("unprocess", "photograph"), ("default", "render")])
def test_an_image_gets_the_raw_of_the_way_and_the_look(way, kind, tmp_path, request):
    """The raw is that of the way alone, the picture that of the look alone from this raw on."""
    image = request.getfixturevalue(kind)
    camera = ("--camera", "nikon-d800", "--iso", load_settings(LOOK).iso)
    kept = ("--keep", "quantize", "--format", "png", *NUMPY)
    both = ("-c", way, "-c", LOOK)
    clpipe("run", image, "-o", tmp_path / "both", *both, *kept)
    clpipe("run", image, "-o", tmp_path / "way", "-c", way, *camera, *kept)
    raw = tmp_path / "both" / "a.quantize.exr"
    one, other = (read_image(p, mosaic=True) for p in (raw, tmp_path / "way" / "a.quantize.exr"))
    assert np.array_equal(one.pixels, other.pixels)
    clpipe(
        *("run", raw, "-o", tmp_path / "look", "-c", LOOK, "--start-at", "normalize"),
        *("--format", "png", *NUMPY),
    )
    made = picture(tmp_path / "both" / "a.png")
    assert np.array_equal(made, picture(tmp_path / "look" / "a.quantize.png"))
    assert not np.array_equal(made, picture(tmp_path / "way" / "a.png"))

    # What is stored of it tells the same.
    sidecar = tmp_path / "both" / "a.json"
    config = json.loads(sidecar.read_text())["request"]["config"]
    assert settings_from(config) == load_settings(way, LOOK)
    clpipe("replay", sidecar, "-o", tmp_path / "again", *NUMPY)
    assert np.array_equal(made, picture(tmp_path / "again" / "a.png"))
    (tmp_path / "saved.toml").write_text(clpipe("plan", *both, "--toml"))
    clpipe("run", image, "-o", tmp_path / "saved", "-c", tmp_path / "saved.toml", *kept)
    assert np.array_equal(made, picture(tmp_path / "saved" / "a.png"))


def test_python_takes_several_too(render, tmp_path):
    names = ["default", LOOK]
    list(api.run(render, tmp_path / "o", names, device="numpy"))
    clpipe("run", render, "-o", tmp_path / "c", "-c", names[0], "-c", names[1], *NUMPY)
    configs = [
        json.loads((tmp_path / folder / "a.json").read_text())["request"]["config"]
        for folder in "oc"
    ]
    assert configs[0] == configs[1]
    assert api.Pipeline(names, device="numpy").settings == load_settings(*names)
