"""Random values of configurations: their distributions, and invalid draws."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import clpipe
from clpipe.base.errors import RequestError
from clpipe.camera.profile import built_in_cameras, load_camera
from clpipe.chain.files import load_settings, toml_text
from clpipe.chain.isos import check_cameras, draw_note
from clpipe.chain.limits import Limits, field_limits
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import overlay, settings_from

KEYS = [f"frames/{number:04}.exr" for number in range(2000)]
LEAST_P = 0.001  # the seed is fixed, and so is the outcome
DRAWS = {
    "camera": {"choice": ["sony-a7r2", "canon-5d2"]},
    "iso": {"log_uniform": [100, 6400]},
    "exposure": {"ev": {"normal": [-0.32, 0.18]}},
    "inverse_white_balance": {"red_gain": {"uniform": [1.9, 2.4]}, "blue_gain": 1.5},
    "restore_highlights": {
        "red_gain": {"same_as": "inverse_white_balance.red_gain"},
        "blue_gain": {"same_as": "inverse_white_balance.blue_gain"},
    },
    "sensor_noise": {
        "method": {"choice": ["gaussian", "poisson"]},
        "b": {"log_normal_of": "sensor_noise.a", "slope": 2.18, "intercept": 1.2, "sigma": 0.26},
        "a": {"log_uniform": [1e-4, 0.012]},
    },
    "denoise": {"method": "mean", "luma_size": {"choice": [3, 5]}},
    "output": {"jpeg_quality": {"uniform": [70, 97]}},
}


@pytest.fixture(scope="module")
def settings():
    return settings_from(DRAWS)


@pytest.fixture(scope="module")
def drawn(settings):
    return [settings.drawn(key) for key in KEYS]


def parameter(drawn, stage, name):
    return np.array([s.parameters[stage][name] for s in drawn])


def test_the_laws_are_those_declared(drawn):
    log_ends = np.log(1e-4), np.log(0.012 / 1e-4)
    for values, law in (
        (np.log([s.iso for s in drawn]), stats.uniform(np.log(100), np.log(64))),
        (parameter(drawn, "exposure", "ev"), stats.norm(-0.32, 0.18)),
        (parameter(drawn, "inverse_white_balance", "red_gain"), stats.uniform(1.9, 0.5)),
        (np.log(parameter(drawn, "sensor_noise", "a")), stats.uniform(*log_ends)),
    ):
        assert stats.kstest(values, law.cdf).pvalue > LEAST_P
    for values in (
        [s.camera for s in drawn],
        [s.parameters["sensor_noise"]["method"] for s in drawn],
        [s.parameters["denoise"]["luma_size"] for s in drawn],
        [s.output.jpeg_quality for s in drawn],
    ):
        counts = np.unique(values, return_counts=True)[1]
        assert len(counts) in (2, 28)
        assert stats.chisquare(counts).pvalue > LEAST_P


def test_what_is_drawn_is_independent(drawn):
    iso, ev, red, a = (
        np.log([s.iso for s in drawn]),
        parameter(drawn, "exposure", "ev"),
        parameter(drawn, "inverse_white_balance", "red_gain"),
        np.log(parameter(drawn, "sensor_noise", "a")),
    )
    between = np.corrcoef([iso, ev, red, a])[np.triu_indices(4, 1)]
    assert np.abs(between).max() < 4 / len(KEYS) ** 0.5


def test_read_noise_follows_shot_noise(drawn):
    a, b = (np.log(parameter(drawn, "sensor_noise", name)) for name in "ab")
    line = stats.linregress(a, b)
    assert line.slope == pytest.approx(2.18, abs=3 * line.stderr)
    assert line.intercept == pytest.approx(1.2, abs=3 * line.intercept_stderr)
    left = b - 2.18 * a - 1.2
    assert stats.kstest(left, stats.norm(0, 0.26).cdf).pvalue > LEAST_P


def test_gains_are_the_same_in_both_places(drawn):
    for name in ("red_gain", "blue_gain"):
        one = parameter(drawn, "inverse_white_balance", name)
        assert np.array_equal(one, parameter(drawn, "restore_highlights", name))


def test_what_is_drawn_belongs_to_seed_and_key_and_nothing_else(settings, drawn):
    first = drawn[0]
    assert settings.drawn(KEYS[0]) == first
    assert overlay(settings, {"seed": 1}).drawn(KEYS[0]).iso != first.iso
    alone = settings_from({"iso": DRAWS["iso"]})
    assert alone.drawn(KEYS[0]).iso == first.iso
    backwards = settings_from({k: DRAWS[k] for k in reversed(DRAWS)})
    assert backwards.drawn(KEYS[0]) == first
    # Golden: these must never change, or nobody's datasets can be made again.
    assert (first.camera, first.iso) == ("sony-a7r2", 109.494214)
    noise = {"method": "poisson", "a": 0.000154569387, "b": 1.48263878e-08}
    assert first.parameters["sensor_noise"] == noise


def test_settings_with_draws_go_through_json(settings, drawn):
    again = settings_from(json.loads(json.dumps(settings.record())))
    assert again == settings
    assert settings_from(json.loads(json.dumps(drawn[0].record()))) == drawn[0]
    assert not drawn[0].draws
    assert drawn[0].drawn("another") is drawn[0]


def test_a_chain_with_draws_is_printed_with_its_draws(settings, tmp_path):
    path = tmp_path / "pipeline.toml"
    path.write_text(toml_text(make_chain(settings)))
    again = load_settings(str(path))
    assert again.draws == settings.draws
    assert again.drawn("a").iso == settings.drawn("a").iso
    assert make_chain(again.drawn("a")).steps == make_chain(settings.drawn("a")).steps


def test_the_chain_of_settings_with_draws_is_an_example(settings):
    chain = make_chain(settings)
    assert chain.settings == settings.drawn("")
    assert chain.iso == chain.settings.iso
    assert chain.camera.name == chain.settings.camera
    assert make_chain(settings.drawn("a")).draws == {}


def test_a_later_value_takes_the_place_of_a_draw(settings):
    over = overlay(settings, {"iso": 800, "sensor_noise": {"a": 1e-3}, "camera": "sony-a7s2"})
    assert {"iso", "camera", "sensor_noise.a"}.isdisjoint(over.draws)
    values = over.drawn("x")
    assert (values.iso, values.camera) == (800, "sony-a7s2")
    assert values.parameters["sensor_noise"]["a"] == 1e-3
    assert np.log(values.parameters["sensor_noise"]["b"]) == pytest.approx(
        2.18 * np.log(1e-3) + 1.2, abs=4 * 0.26
    )
    plain = settings_from({"iso": 800, "exposure": {"ev": 1.0}})
    later = overlay(plain, {"iso": {"choice": [400]}, "exposure": {"ev": {"choice": [2.0]}}})
    assert later.drawn("").iso == 400
    assert later.drawn("").parameters["exposure"] == {"ev": 2.0}


def test_a_normal_ends_where_its_parameter_does():
    settings = settings_from({"row_noise": {"sigma": {"normal": [0.01, 0.02]}}})
    sigmas = parameter([settings.drawn(key) for key in KEYS[:200]], "row_noise", "sigma")
    assert sigmas.min() == 0
    assert 0.2 < np.mean(sigmas == 0) < 0.45  # Phi(-0.5) = 0.31
    wide = settings_from({"iso": {"normal": [3200, 3200]}, "camera": DRAWS["camera"]})
    make_chain(wide)
    isos = [wide.drawn(key).iso for key in KEYS[:200]]
    # Each camera draws from what it has, and nothing is heaped where that ends.
    assert 100 < min(isos) < 400 and 6400 < max(isos) < 12800
    assert len({*isos}) == len(isos)


def test_choices_of_lists_and_texts():
    matrices = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]]
    settings = settings_from(
        {
            "color_matrix": {"method": "given", "matrix": {"choice": matrices}},
            "mosaic": {"pattern": {"choice": ["RGGB", "GBRG"]}},
        }
    )
    values = [settings.drawn(key).parameters for key in KEYS[:20]]
    assert all(v["color_matrix"]["matrix"] in matrices for v in values)
    assert {v["mosaic"]["pattern"] for v in values} == {"RGGB", "GBRG"}


def test_files_that_are_drawn_are_relative_to_the_configuration(tmp_path):
    for name in ("one", "two"):
        (tmp_path / f"{name}.csv").write_text("0,0\n1,1\n")
        (tmp_path / f"{name}.toml").write_text(built_in_cameras()["sony-a7r2"].read_text())
    path = tmp_path / "pipeline.toml"
    path.write_text(
        'camera = { choice = ["one.toml", "two.toml", "canon-5d2"] }\n'
        '[tone_curve]\nmethod = { choice = ["file"] }\npath = { choice = ["one.csv", "two.csv"] }\n'
    )
    settings = load_settings(str(path))
    values = [settings.drawn(key) for key in KEYS[:40]]
    assert {v.camera for v in values} == {
        *(str(tmp_path / name) for name in ("one.toml", "two.toml")),
        "canon-5d2",
    }
    assert {v.parameters["tone_curve"]["path"] for v in values} == {
        str(tmp_path / name) for name in ("one.csv", "two.csv")
    }
    path.write_text('[tone_curve]\nmethod = "file"\npath = { choice = ["one.csv", "no.csv"] }\n')
    with pytest.raises(RequestError, match=r"line 3: tone_curve.path: .*no.csv.*cannot be read"):
        load_settings(str(path))


def test_a_pipeline_draws_by_the_key():
    image = np.full((4, 6, 3), 0.25, np.float32)
    ev = {"uniform": np.array([-1.0, 1.0])}
    exposure = {"ev": ev, "headroom": 0}
    camera = clpipe.Pipeline(stages=["exposure"], exposure=exposure, device="numpy")
    settings = settings_from({"exposure": {"ev": {"uniform": [-1, 1]}}})
    for key in ("a", "b"):
        gain = np.float32(2.0 ** settings.drawn(key).parameters["exposure"]["ev"])
        assert np.array_equal(camera.process(image, key).image, image * gain)
    shot = camera.process(image, "a", exposure={"ev": 1.0})
    assert np.array_equal(shot.image, image * 2)
    assert not np.array_equal(camera.process(image, "a", seed=1).image, image * gain)


def test_brooks_2019():
    settings = load_settings("brooks2019")
    values = [settings.drawn(key) for key in KEYS[:500]]
    gain = 2.0 ** parameter(values, "exposure", "ev")
    assert (gain.mean(), gain.std()) == (pytest.approx(0.8, abs=0.02), pytest.approx(0.1, abs=0.02))
    blue = parameter(values, "inverse_white_balance", "blue_gain")
    assert 1.5 < blue.min() < 1.51 and 1.89 < blue.max() < 1.9
    for one in values[:20]:
        chain = make_chain(one)
        gains = chain.step_named("inverse_white_balance").method
        assert chain.step_named("white_balance").method.model_dump() == gains.model_dump()
        assert (chain.noise.a, chain.noise.b) == tuple(
            one.parameters["sensor_noise"][x] for x in "ab"
        )


def test_syb3r():
    dark = np.full((40, 60, 3), 0.02, np.float32)
    noisy = clpipe.Pipeline("syb3r", device="numpy", iso=1600, until="sensor_noise")
    clean = clpipe.Pipeline("syb3r", device="numpy", skip=["sensor_noise"], until="mosaic")
    signal = clean.process(dark, "a").image
    assert signal.mean() == pytest.approx(0.18 / 2, rel=0.01)  # auto exposure, with its headroom
    noise = noisy.process(dark, "a").image - signal
    law = noisy.chain.noise
    assert noise.var() == pytest.approx(law.a * signal.mean() + law.b, rel=0.1)
    line = dark.copy()
    line[:, 30] = 1.0
    shots = [clean.process(line, key).image for key in "abc"]
    assert not np.allclose(shots[0], shots[1]) and not np.allclose(shots[1], shots[2])
    finished = clpipe.Pipeline("syb3r", device="numpy", iso=1600).process(dark, "a").image
    assert finished.shape == dark.shape and finished.std((0, 1)).min() > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("iso = { choise = [1] }", "line 1: iso: found .*unknown draw 'choise' .*mean 'choice'"),
        ("iso = {}", "line 1: iso: found {}: unknown draw ''"),
        ("iso = { choice = [] }", "iso: choice: found .*at least 1 item"),
        ("iso = { choice = 3 }", "iso: choice: found 3: should be a valid list"),
        ("iso = { choice = [100, 'x'] }", "iso: found 'x', but expected a number"),
        ("iso = { choice = [[100]] }", r"iso: found \[100\], but expected a number"),
        (
            "iso = { choice = [{ uniform = [1, 2] }] }",
            "null and tables are not allowed; list plain values",
        ),
        (
            "iso = { uniform = [1, 2], choice = [3] }",
            "one distribution, but these are choice and uniform",
        ),
        ("iso = { uniform = [100] }", "iso: uniform: the draw uniform needs|iso: uniform: .*found"),
        ("iso = { uniform = [100, 200, 300] }", "iso: uniform: found"),
        ("iso = { uniform = ['a', 200] }", "iso: uniform: found 'a': should be a valid number"),
        ("iso = { uniform = [100, inf] }", "iso: uniform: found inf: .*finite"),
        ("iso = { uniform = [200, 100] }", "uniform: found .200, 100.; put the lower end first"),
        ("iso = { log_uniform = [0, 100] }", "both ends must be above 0"),
        ("iso = { normal = [800, -1] }", "the standard deviation must be 0 or more"),
        ("iso = { uniform = [100, 200], sigma = 2 }", "unknown key of uniform 'sigma'"),
        (
            "seed = { choice = [1, 2] }",
            "line 1: seed: found .*cannot be drawn; only camera, iso, lens",
        ),
        ("dump = { choice = ['8x8'] }", "dump: found .*cannot be drawn"),
        ("camera = { uniform = [1, 2] }", "camera: found .*but a name can only be drawn by choice"),
        ("camera = { choice = [3] }", "camera: found 3, but expected text"),
        ("[sensor_noise]\na = { uniform = [-1, 1] }", "line 2: sensor_noise.a: found -1.*greater"),
        ("[sensor_noise.a]\nuniform = [0, 2]", "line 1: sensor_noise.a: found 2.*less than"),
        ("[sensor_noise]\na.uniform = [0, 2]", "line 2: sensor_noise.a: found 2"),
        ("[sensor_noise]\na = { normal = [2, 1] }", "line 2: sensor_noise.a: found 2"),
        ("[sensor_noise]\naa = { uniform = [0, 1] }", "line 2: unknown parameter of sensor_noise"),
        ("[sensr_noise]\na = { uniform = [0, 1] }", "unknown stage 'sensr_noise'"),
        ("[mosaic]\npattern = { uniform = [0, 1] }", "with one number as its value; use choice"),
        ("[mosaic]\npattern = { choice = ['RGGB', 'RGBG'] }", "mosaic.pattern: found 'RGBG'"),
        ("[mosaic_denoise]\nsize = { uniform = [3, 7] }", "size: found 4: it must be odd"),
        ("[mosaic_denoise]\nsize = { uniform = [3.5, 7] }", "size: found 3.5: .*integer"),
        ("[quantize]\nbits = { uniform = [4, 12] }", "quantize.bits: found 4: .*greater"),
        ("[demosaic]\nmethod = { choice = ['biliner'] }", "unknown method 'biliner'"),
        ("[demosaic]\nmethod = { uniform = [1, 2] }", "method: found .*drawn by choice"),
        (
            "[denoise]\nmethod = { choice = ['mean', 'median'] }\nluma_size = 9",
            "denoise.luma_size: found 9: it must be odd, 1 to",
        ),
        (
            "[demosaic]\nmethod = { choice = ['median', 'bilinear'] }\nsize = { choice = [3, 5] }",
            r"line 3: unknown parameter of demosaic .bilinear. 'size'",
        ),
        ("[output]\njpeg_quality = { uniform = [0, 90] }", "output.jpeg_quality: found 0: "),
        ("[output]\nquality = { uniform = [50, 90] }", "unknown key of output 'quality'"),
        ("[exposure]\nev = { same_as = 'exposure.e' }", "line 2: exposure.ev: unknown value"),
        ("[exposure]\nev = { same_as = 'exposure.ev' }", "exposure.ev: the draw follows itself"),
        ("[exposure]\nev = { same_as = 'camera' }", "exposure.ev: found 'sony-a7r2'"),
        ("[exposure]\nev = { same_as = 3 }", "exposure.ev: same_as: found 3: should be .*string"),
        (
            "[row_noise]\nsigma = { same_as = 'dsnu.sigma' }\n"
            "[dsnu]\nsigma = { same_as = 'row_noise.sigma' }",
            "line 2: row_noise.sigma: the draw follows itself: row_noise.sigma -> dsnu.sigma",
        ),
        (
            "[sensor_noise]\nb = { log_normal_of = 'sensor_noise.a', slope = 1, intercept = 0 }",
            "line 2: sensor_noise.b: sigma: the draw log_normal_of needs",
        ),
        (
            "[sensor_noise]\na = { normal = [0.01, 0.01] }\n"
            "b = { log_normal_of = 'sensor_noise.a', slope = 1, intercept = 0, sigma = 1 }",
            "sensor_noise.b: found .*sensor_noise.a, but sensor_noise.a can be",
        ),
        (
            "[quantize]\nblack_level = { uniform = [0, 600] }\nwhite_level = 500.0",
            "quantize: white_level must be above black_level",
        ),
    ],
)
def test_a_draw_that_cannot_be(tmp_path, text, message):
    path = tmp_path / "pipeline.toml"
    path.write_text(text + "\n")
    with pytest.raises(RequestError, match=f"pipeline.toml.*{message}"):
        load_settings(str(path))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"iso": {"uniform": [50, 800]}}, "iso: found 50, but camera sony-a7r2 goes from 100"),
        (
            {"iso": {"uniform": [100, 50000]}, "camera": {"choice": ["canon-5d2", "sony-a7r2"]}},
            "iso: found 50000, but camera sony-a7r2 goes from 100 to 25600",
        ),
        (
            {"iso": {"choice": [12800]}, "camera": {"choice": ["canon-5d2", "sony-a7r2"]}},
            r"iso: found .*12800.*, but none of these ISOs is in the range of camera canon-5d2",
        ),
        ({"iso": 50, "camera": {"choice": ["sony-a7s2", "canon-5d2"]}}, "found 50, but camera can"),
        ({"camera": {"choice": ["sony-a7r2", "sony-a7r9"]}}, "unknown camera 'sony-a7r9'"),
    ],
)
def test_an_iso_that_a_camera_has_not(values, message):
    with pytest.raises(RequestError, match=message):
        make_chain(settings_from(values))


def test_the_limits_of_a_parameter_are_its_own():
    sensor, exposure, bits = (all_stages()[n] for n in ("sensor_noise", "exposure", "quantize"))
    assert field_limits(sensor.methods[0], "a") == Limits(0, 1)
    above = field_limits(sensor.methods[0], "tukey_lambda").low
    assert -0.5 < above < -0.4999
    assert field_limits(exposure.methods[0], "ev") == Limits(-20, 20)
    assert field_limits(bits.methods[0], "bits") == Limits(8, 24, whole=True)
    assert field_limits(all_stages()["mosaic"].methods[0], "pattern") is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "share"),
    [
        ({"log_uniform": [800, 12800]}, None),
        ({"uniform": [800, 12800]}, None),
        ({"normal": [5000, 4000]}, None),
        ({"choice": [800, 1600, 6400, 12800]}, 1 / 3),
    ],
)
def test_each_camera_draws_in_its_own_part_of_a_law(law, share):
    cameras = {"sony-a7r2": 12800, "canon-6d": 6400}
    settings = settings_from({"iso": law, "camera": {"choice": list(cameras)}})
    check_cameras(settings)
    drawn = [settings.drawn(f"{n}.exr") for n in range(2000)]
    for name, highest in cameras.items():
        isos = np.array([each.iso for each in drawn if each.camera == name])
        assert 900 < len(isos) < 1100 and (isos <= highest + 12800 * ("normal" in law)).all()
        heap = np.mean(isos == isos.max())
        assert heap < (0.01 if share is None else share + 0.1)
        if "log_uniform" in law:  # its law is kept: as many in each half of what a camera has
            middle = np.sqrt(800 * highest)
            assert abs(np.mean(isos < middle) - 0.5) < 0.05
    says = draw_note(settings)
    assert says in ("", "iso: drawn within each camera's range: canon-6d from 100 to 6400")
    assert bool(says) is ("normal" not in law)


def test_one_camera_is_pushed_where_a_law_goes_on(clpipe, write_exr):
    """Above the highest ISO, gain and variance are extrapolated in proportion, with a note."""
    settings = settings_from({"iso": {"log_uniform": [1600, 25600]}, "camera": "nikon-d800"})
    isos = np.array([settings.drawn(f"{n}.exr").iso for n in range(400)])
    assert abs(np.mean(isos > 6400) - 0.5) < 0.08 and isos.max() > 20000
    drawn = next(s for n in range(400) if (s := settings.drawn(f"{n}.exr")).iso > 12800)
    camera, step = load_camera("nikon-d800"), make_chain(drawn).step_named("sensor_noise")
    highest = camera.noise(6400)
    assert step.method.a == pytest.approx(highest.a * drawn.iso / 6400)
    assert step.method.b == pytest.approx(highest.b * (drawn.iso / 6400) ** 2)
    note = "iso: the draw goes above 6400, the highest ISO of nikon-d800"
    assert draw_note(settings).startswith(note)
    write_exr("a.exr", np.full((4, 6, 3), 0.25))
    Path("c.toml").write_text("camera = 'nikon-d800'\niso = { log_uniform = [12800, 25600] }\n")
    stderr = clpipe("run", "a.exr", "-o", "out", "--device", "numpy", "-c", "c.toml").stderr
    assert stderr.count(note) == 1
    sidecar = json.loads(Path("out/a.json").read_text())
    assert 12800 <= sidecar["iso"] <= 25600
    clpipe("replay", "out/a.json", "-o", "again", "--device", "numpy")
    assert Path("again/a.jpg").read_bytes() == Path("out/a.jpg").read_bytes()
    for law in ({"log_uniform": [1600, 51200]}, {"choice": [25601]}):
        with pytest.raises(RequestError, match="camera nikon-d800 goes from 100 to 6400"):
            make_chain(settings_from({"iso": law, "camera": "nikon-d800"}))
    with pytest.raises(RequestError, match="found 12800, but camera nikon-d800"):
        make_chain(settings_from({"iso": 12800, "camera": "nikon-d800"}))


def test_what_no_camera_has_is_refused_before_a_run(clpipe, write_exr):
    write_exr("a.exr", np.full((4, 6, 3), 0.25))
    run = ("run", "a.exr", "-o", "out", "--device", "numpy")
    Path("c.toml").write_text("camera = { choice = ['sony-a7r2', 'canon-6d'] }\niso = 12800\n")
    refused = clpipe(*run, "-c", "c.toml", status=2).stderr
    assert "iso: found 12800, but camera canon-6d goes from 100 to 6400" in refused
    Path("c.toml").write_text(
        "camera = { choice = ['sony-a7r2', 'canon-6d'] }\niso = { log_uniform = [800, 12800] }\n"
    )
    stderr = clpipe(*run, "-c", "c.toml").stderr
    assert stderr.count("iso: drawn within each camera's range: canon-6d from 100 to 6400") == 1
