"""Foreign noise models as camera profiles: DNG, Android, darktable."""

import json

import numpy as np
import pytest

from clpipe.analysis.noise_models.read import import_camera
from clpipe.base.errors import ClpipeError, ImageError, RequestError
from clpipe.camera.profile import load_camera
from tests.dng import field, write_dng

ANDROID = """
/* planes in R, Gr, Gb, B order */
int main(void) { for (int sens = 50; sens <= 3200; sens += 100) { } return 0; }
double compute_noise_model_entry_S(int plane, int sens) {
    static double noise_model_A[] = { 9e-7,1.0e-06,1.4e-06,9e-7 };
    static double noise_model_B[] = { 9e-6,2e-6,4e-6,-9e-6 };
}
double compute_noise_model_entry_O(int plane, int sens) {
    double digital_gain = (sens / 800.0) < 1.0 ? 1.0 : (sens / 800.0);
    static double noise_model_C[] = { 9e-12,4e-12,6e-12,9e-12 };
    static double noise_model_D[] = { 9e-7,3e-7,3e-7,9e-7 };
}
"""


def noise_profile(*values):
    return field(51041, 12, *values)


def dng(path, *values, shape=(32, 32), **options):
    rng = np.random.default_rng(1)
    changes = [noise_profile(*values)] if values else []
    return write_dng(path, rng.integers(500, 9000, shape), changes=changes, **options)


def darktable(path, *makers, raw=None):
    """A file of darktable's form of makers, each with its models and their a of green by ISO."""
    made = [
        {
            "maker": maker,
            "models": [
                {
                    "model": model,
                    "profiles": [
                        {"name": "x", "iso": iso, "a": [9e-5, a, 9e-5], "b": [-1e-8] * 3}
                        for iso, a in slopes.items()
                    ],
                }
                for model, slopes in models.items()
            ],
        }
        for maker, models in makers
    ]
    path.write_text(raw or json.dumps({"version": 0, "noiseprofiles": made}))
    return path


@pytest.fixture
def imported(tmp_path):
    """The profile of a file, as load_camera reads what was written."""

    def load(path, camera=None):
        output = tmp_path / "made.toml"
        text, made = import_camera(path, camera, output)
        assert output.read_text() == text
        assert load_camera(str(output)) == made
        return made

    return load


def test_a_dng(imported, tmp_path):
    path = dng(tmp_path / "a.dng", 9e-4, 9e-7, 2e-4, 3e-7, 9e-4, 9e-7, model=b"EOS X1", iso=640)
    camera = imported(path)
    noise = camera.noise(640)
    assert (noise.a, noise.b) == (pytest.approx(2e-4), pytest.approx(3e-7, rel=1e-5))
    assert (camera.black_level, camera.white_level) == (512, 16383)
    assert (camera.make, camera.model, camera.name) == ("Canon", "EOS X1", "made")
    assert camera.xyz_to_camera[0] == pytest.approx((0.4716, 0.0603, -0.0830))
    assert camera.white_balance_gains == pytest.approx((2.574, 1.387), abs=0.001)
    assert camera.iso_range == (640, 640)
    assert "NoiseProfile" in camera.sources["system_gain"]
    assert "ColorMatrix" in camera.sources["xyz_to_camera"]


def test_a_dng_without_a_matrix_and_with_one_pair_for_all_colours(imported, tmp_path):
    path = dng(tmp_path / "a.dng", 1e-4, 2e-7, model=b"Unknown", make=b"Nobody", matrix=None)
    camera = imported(path)
    assert camera.noise(400).b == pytest.approx(2e-7, rel=1e-5)
    assert camera.xyz_to_camera is None and camera.white_balance_gains == (2.0, 1.6)
    assert "as shot" in camera.sources["white_balance_gains"]


def test_the_dng_that_clpipe_writes_has_the_noise_of_its_camera(
    clpipe, write_exr, imported, tmp_path
):
    render = write_exr("a.exr", np.full((32, 32, 3), 0.2, np.float32))
    options = ("--format", "dng", "--camera", "Nikon D850", "--iso", 1600, "--device", "numpy")
    clpipe("run", render, "-o", tmp_path / "out", *options)
    camera, own = imported(tmp_path / "out" / "a.dng"), load_camera("nikon-d850")
    assert camera.model == "D850"
    assert camera.noise(1600).a == pytest.approx(own.noise(1600).a, rel=1e-5)
    assert camera.noise(1600).b == pytest.approx(own.noise(1600).b, rel=1e-5)
    assert camera.white_balance_gains == pytest.approx(own.white_balance_gains, rel=0.01)


@pytest.mark.parametrize(
    ("values", "options", "message"),
    [
        ((), {}, "has no NoiseProfile .tag 51041."),
        ((1e-4, 1e-7, 1e-4), {}, "its NoiseProfile has 3 numbers"),
        ((1e-4, -1e-7), {}, "b = -1e-07 for green; both must be above 0"),
        ((float("nan"), 1e-7), {}, "a = nan"),
        ((1e-4, 1e-7), {"shape": (32, 32, 3)}, "has all colours at each pixel .a LinearRaw"),
        ((1e-4, 1e-7), {"black": (9000,) * 4, "white": 500}, "levels are impossible"),
    ],
)
def test_a_dng_that_cannot_be_used(tmp_path, values, options, message):
    with pytest.raises(ImageError, match=rf"a\.dng: .*{message}"):
        import_camera(dng(tmp_path / "a.dng", *values, **options), None, None)


def test_an_android_noise_model(imported, tmp_path):
    path = tmp_path / "phone.c"
    path.write_text(ANDROID)
    camera = imported(path)
    assert camera.iso_range == (50, 3200)
    assert camera.gain_stages[0].iso == (50, 100, 200, 400, 800, 1600, 3200)
    for iso, digital_gain in ((100, 1), (800, 1), (3200, 4)):
        noise = camera.noise(iso)
        assert noise.a == pytest.approx(1.2e-6 * iso + 3e-6, rel=1e-5)
        b = 5e-12 * iso**2 + 3e-7 * digital_gain**2
        assert noise.b == pytest.approx(b, rel=1e-5)
    assert "10 bits" in camera.sources["levels"] and "not in" in camera.sources["levels"]


def test_an_android_noise_model_as_json_with_one_plane(imported, tmp_path):
    values = {"noise_model_A": [1e-6], "noise_model_B": [0], "noise_model_C": [4e-12]}
    path = tmp_path / "phone.json"
    path.write_text(json.dumps({**values, "noise_model_D": [1e-7]}))
    camera = imported(path)
    assert camera.noise(1600).a == pytest.approx(1.6e-3)
    assert "assumed: 100 to 1600" in camera.sources["system_gain"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("noise_model_D", "noise_model_E", "noise_model_D = .* is missing"),
        ("{ 9e-6,2e-6,4e-6,-9e-6 }", "{ 9e-6,2e-6 }", "noise_model_B is '9e-6,2e-6'"),
        ("9e-12,4e-12", "9e-12,x", "noise_model_C is"),
        ("1.0e-06,1.4e-06", "-1.0e-02,-1.4e-02", "a and b are not both above 0 at any ISO"),
        ("sens / 800.0", "sens / 0.0", "highest analogue ISO is 0"),
        ("1.0e-06,1.4e-06", "1e9,1e9", "makes no valid profile: gain_stages"),
    ],
)
def test_an_android_noise_model_that_is_damaged(tmp_path, old, new, message):
    path = tmp_path / "phone.c"
    assert old in ANDROID
    path.write_text(ANDROID.replace(old, new))
    with pytest.raises(RequestError, match=message):
        import_camera(path, None, None)


MAKERS = (
    ("Nikon", {"D1": {100: 9e-6, 800: 2e-5, 1600: 4e-5, 6400: 1.7e-4}, "D2": {800: 1e-5}}),
    ("Sony", {"ILCE-7M2": {50: 9e-6, 100: 2e-6, 200: 3e-6}}),
)


def test_the_noise_of_darktable_is_converted_to_that_of_the_raw(imported, tmp_path):
    camera = imported(darktable(tmp_path / "n.json", *MAKERS), "nikon d1")
    assert camera.noise(800).a == pytest.approx(12.8 * 2e-5)
    assert camera.noise(6400).a == pytest.approx(12.8 * 1.7e-4)
    # Below ISO 800 it is in proportion to the ISO, not what the file has.
    assert camera.noise(100).a == pytest.approx(12.8 * 2e-5 / 8)
    assert "12.8" in camera.sources["system_gain"] and "30 %" in camera.sources["system_gain"]
    assert camera.sources["read_noise"].startswith("not known; assumed")
    # The stand-in's law, in DN of 14 bits.
    assert camera.gain_stages[0].read_noise[1] == pytest.approx(
        np.exp(0.6 * np.log(12.8 * 2e-5 * 15871) + 1.521), rel=1e-4
    )


def test_isos_whose_raws_are_scaled_or_denoised_are_left_out(imported, tmp_path):
    slopes = {800: 2e-5, 1250: 1e-5, 1600: 4e-5, 3200: 8e-5, 51200: 3e-4}
    camera = imported(darktable(tmp_path / "n.json", ("Canon", {"EOS X": slopes})))
    assert camera.gain_stages[0].iso == (800, 1600, 3200)
    assert (
        "left out, because a/ISO is far from the others': ISO 1250, 51200"
        in (camera.sources["system_gain"])
    )


@pytest.mark.parametrize(("model", "is_bayer"), [("X-T10", False), ("X-T100", True)])
def test_x_trans_is_refused(tmp_path, model, is_bayer):
    path = darktable(tmp_path / "n.json", ("Fujifilm", {model: {800: 2e-5}}))
    if is_bayer:
        assert import_camera(path, None, None)[1].model == model
        return
    with pytest.raises(RequestError, match="Fujifilm X-T10 has an X-Trans pattern"):
        import_camera(path, None, None)


def test_of_a_camera_that_is_built_in_the_levels_and_the_matrix_are_known(imported, tmp_path):
    camera = imported(darktable(tmp_path / "n.json", *MAKERS), "Sony A7 II")
    own = load_camera("sony-a7m2")
    assert camera.model == "ILCE-7M2" and camera.iso_range == (100, 200)
    assert camera.noise(200).a == pytest.approx(12.8 * 3e-6, rel=1e-5)
    assert (camera.black_level, camera.white_level) == (own.black_level, own.white_level)
    assert camera.xyz_to_camera == own.xyz_to_camera
    assert "sony-a7m2" in camera.sources["levels"]


def test_the_only_camera_needs_no_name_and_what_darktable_skips_is_skipped(imported, tmp_path):
    profiles = [
        {"iso": 800, "a": [1, 5e-5, 1], "b": [0, 0, 0], "skip": True},
        {"iso": 800, "a": [1, 2e-5, 1], "b": [0, 0, 0]},
    ]
    raw = {"noiseprofiles": [{"maker": "M", "models": [{"model": "X", "profiles": profiles}]}]}
    camera = imported(darktable(tmp_path / "n.json", raw=json.dumps(raw)))
    assert camera.noise(800).a == pytest.approx(12.8 * 2e-5)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (None, "this file has 3 cameras; choose one, such as --camera 'Nikon D1'"),
        (
            "Nikon D11",
            "camera 'Nikon D11' is not among its 3 cameras; similar are Nikon D1, Nikon D2",
        ),
        ("\x1b[31m", r"camera '\\x1b\[31m' is not among its 3 cameras; one is Nikon D1"),
    ],
)
def test_a_camera_that_the_file_has_not(tmp_path, camera, message):
    with pytest.raises(RequestError, match=message):
        import_camera(darktable(tmp_path / "n.json", *MAKERS), camera, None)


def one(profiles):
    entry = {"maker": "M", "models": [{"model": "X", "profiles": profiles}]}
    return json.dumps({"noiseprofiles": [entry]})


GOOD = '{"iso": 800, "a": [1, 2e-5, 1], "b": [0, 0, 0]}'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains nothing; give a DNG"),
        ("a,b\n1,2\n", "contains text without a noise model; give a DNG .*noiseprofiles.json"),
        ('{"noiseprofiles": [', "damaged, or not valid JSON"),
        ('{"noiseprofiles":' + "[" * 100_000, "nested too deeply"),
        ('{"noiseprofiles": 3}', "list no camera"),
        ('{"noiseprofiles": [1, {"maker": 2}, {"maker": "M", "models": [[]]}]}', "list no camera"),
        (one([]), "M X has no profiles"),
        (one({"iso": 1}), "M X: profiles.*list"),
        (one([{"iso": 800}]), r"profiles\[0\].a: it is missing"),
        (one([{"iso": -1, "a": [1, 1e-5, 1]}]), r"profiles\[0\].iso: found -1"),
        (one([{"iso": 800, "a": [1, float("nan"), 1]}]), r"profiles\[0\].a\[1\]: found nan"),
        (one([{"iso": 800, "a": [1, 10**400, 1]}]), r"profiles\[0\].a\[1\]"),
    ],
)
def test_a_text_that_is_no_noise_model(tmp_path, text, message):
    path = tmp_path / "n.json"
    path.write_text(text)
    with pytest.raises(RequestError, match=rf"n\.json: .*{message}"):
        import_camera(path, None, None)


def test_time_is_bounded_where_a_text_repeats(tmp_path):
    path = tmp_path / "a.c"
    path.write_text("noise_model_A[] = {1," * 300_000)  # 6 MiB; a search that starts again at each
    with pytest.raises(RequestError, match=r"noise_model_A is|noise_model_. = .* is missing"):
        import_camera(path, None, None)


def test_names_in_a_file_print_in_one_line(tmp_path):
    path = tmp_path / "n.json"
    path.write_text(one([json.loads(GOOD)]).replace('"X"', '"X\\u001b[31m\\ny\\u007f"'))
    text, made = import_camera(path, None, None)
    assert all(line.isprintable() for line in text.splitlines())
    assert made.model.isprintable()


def test_the_command(clpipe, tmp_path):
    path = darktable(tmp_path / "n.json", *MAKERS)
    printed = clpipe("cameras", "import", path, "--camera", "Nikon D1").stdout
    assert 'name = "nikon-d1"' in printed and "[sources]" in printed
    mine = tmp_path / "new" / "mine.toml"
    wrote = clpipe("cameras", "import", path, "--camera", "d2", "-o", mine).stdout
    assert wrote == f"wrote {mine}: Nikon D2, ISO 800\n"
    assert "Nikon D2" in clpipe("cameras", mine).stdout
    wrong = tmp_path / "a.txt"
    refused = clpipe("cameras", "import", path, "--camera", "d2", "-o", wrong, status=2)
    assert "must end in .toml" in refused.stderr and not wrong.exists()
    for file in ("/dev/zero", tmp_path):
        text = clpipe("cameras", "import", file, status=2).stderr
        assert "give a DNG" in text and text.count("\n") == 1
    model = dng(tmp_path / "a.dng", 1e-4, 1e-7)
    text = clpipe("cameras", "import", model, "--camera", "x", status=2).stderr
    assert "has only one camera" in text
    assert "import FILE" in clpipe("cameras", "--help").stdout
    assert "cameras import [OPTIONS] FILE" in clpipe("cameras", "import", "-h").stdout


def test_a_file_that_only_seems_to_be_one(tmp_path):
    for name, data in (("a.dng", b"II*\0" + bytes(64)), ("b.json", b"\xff\xfe{" * 9)):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ClpipeError, match=name):
            import_camera(tmp_path / name, None, None)
