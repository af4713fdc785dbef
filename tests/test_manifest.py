"""Manifests: the values of rows, and the messages about wrong rows."""

import json
import ntpath
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from clpipe.base.errors import RequestError
from clpipe.camera.profile import built_in_cameras
from clpipe.chain.files import load_settings
from clpipe.chain.making import make_chain
from clpipe.chain.request import Request
from clpipe.chain.settings import settings_from
from clpipe.chain.toml import toml_value
from clpipe.inputs.find import Job
from clpipe.inputs.manifest import check_output_name, check_rows, read_manifest
from tests.conftest import noise_report

DEFAULT = settings_from({})


@pytest.fixture
def manifest(tmp_path):
    """Read a manifest with this text."""

    def read(text, name="frames.csv"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_manifest(path)

    return read


@pytest.mark.parametrize("bom", ["", "\ufeff"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_csv(manifest, tmp_path, bom, end):
    lines = [
        "path, name,frames,iso,camera,seed,sensor_noise.a,demosaic.method,render.focal_length",
        "a.exr,,,,,,,,",
        "",
        "b/c.0001.exr,view1/c.0001,3, 800 ,canon-5d2,7,1e-4,bilinear,35",
        '"d, e.exr",,,"{choice = [100, 400]}",,,"{uniform = [1e-4, 2e-4]}",,',
    ]
    rows = manifest(bom + end.join(lines))
    assert rows == [
        Job(tmp_path / "a.exr", "a.exr", location=f"{tmp_path}/frames.csv, row 2"),
        Job(
            tmp_path / "b/c.0001.exr",
            "view1/c.0001",
            "view1/c.0001",
            values={
                "iso": 800,
                "camera": "canon-5d2",
                "seed": 7,
                "sensor_noise": {"a": 1e-4},
                "demosaic": {"method": "bilinear"},
                "render": {"focal_length": 35},
            },
            frames=3,
            location=f"{tmp_path}/frames.csv, row 4",
        ),
        Job(
            tmp_path / "d, e.exr",
            "d, e.exr",
            values={
                "iso": {"choice": [100, 400]},
                "sensor_noise": {"a": {"uniform": [1e-4, 2e-4]}},
            },
            location=f"{tmp_path}/frames.csv, row 5",
        ),
    ]
    assert [row.stem for row in rows] == ["a", "view1/c.0001", "d, e"]


def test_a_jsonl(manifest, tmp_path):
    lines = [
        '{"path": "a.exr", "iso": 800, "sensor_noise": {"a": 1e-4, "b": null}, "name": null}',
        "",
        '{"path": "b.exr", "name": "b.\u2028x", "sensor_noise.a": {"uniform": [1e-4, 2e-4]}, '
        '"demosaic.method": {"choice": ["bilinear", "median"]}, "frames": 2}',
        '{"path": "c.exr", "camera": {"choice": ["sony-a7r2", "canon-5d2"]}}',
    ]
    rows = manifest("\r\n".join(lines), "frames.JSONL")
    assert [row.values for row in rows] == [
        {"iso": 800, "sensor_noise": {"a": 1e-4}},
        {
            "sensor_noise": {"a": {"uniform": [1e-4, 2e-4]}},
            "demosaic": {"method": {"choice": ["bilinear", "median"]}},
        },
        {"camera": {"choice": ["sony-a7r2", "canon-5d2"]}},
    ]
    assert [(row.name, row.frames) for row in rows] == [("", None), ("b.\u2028x", 2), ("", None)]
    assert [row.location[-5:] for row in rows] == ["row 1", "row 3", "row 4"]
    check_rows(rows, DEFAULT)


@pytest.mark.parametrize(
    ("path", "key"),
    [
        ("a.exr", "a.exr"),
        ("./b/../c/a.exr", "c/a.exr"),
        ("{folder}/b/a.exr", "b/a.exr"),
        ("../b/a.exr", "a.exr"),
        ("/elsewhere/b/a.exr", "a.exr"),
        ("..a/b.exr", "..a/b.exr"),
    ],
)
def test_the_image_key(manifest, tmp_path, monkeypatch, path, key):
    (row,) = manifest("path\n" + path.format(folder=tmp_path))
    assert row.key == key
    monkeypatch.chdir(tmp_path)
    (row,) = read_manifest(Path("frames.csv"))
    assert row.key == key
    (row,) = manifest("path,name\n" + path.format(folder=tmp_path) + ",x/y")
    assert row.key == row.stem == "x/y"


def test_one_path_with_two_names(manifest):
    rows = manifest("path,name,iso\na.exr,low,100\na.exr,high,6400")
    assert rows[0].path == rows[1].path
    assert [row.key for row in rows] == ["low", "high"]


def test_files_are_relative_to_the_manifest(manifest, tmp_path):
    (tmp_path / "mine.toml").write_text(built_in_cameras()["sony-a7r2"].read_text())
    (tmp_path / "curve.csv").write_text("0,0\n1,1\n")
    rows = manifest(
        "path,camera,tone_curve.path\n"
        "a.exr,mine.toml,curve.csv\n"
        'b.exr,"{choice=[""mine.toml"", ""sony-a7r2""]}","{choice=[""curve.csv""]}"\n'
    )
    mine, curve = str(tmp_path / "mine.toml"), str(tmp_path / "curve.csv")
    assert rows[0].values == {"camera": mine, "tone_curve": {"path": curve}}
    assert rows[1].values == {
        "camera": {"choice": [mine, "sony-a7r2"]},
        "tone_curve": {"path": {"choice": [curve]}},
    }
    base = settings_from({"tone_curve": {"method": "file"}})
    one, two = check_rows(rows, base)
    assert make_chain(one).step_named("tone_curve").method.path == curve
    assert two.drawn("b").parameters["tone_curve"]["path"] == curve


def test_rows_lie_over_settings(manifest):
    base = load_settings("brooks2019")
    rows = manifest("path,iso,sensor_noise.a,denoise.method\na.exr,400,1e-3,\nb.exr,,,mean\n")
    one, two = check_rows(rows, base)
    assert one.iso == 400
    assert one.drawn("a").parameters["sensor_noise"]["a"] == 1e-3
    assert two.parameters["denoise"] == {"method": "mean"}
    assert two.draws == base.draws


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "frames.csv: this manifest is empty; its first row must name columns, such as path"),
        ("\n\n", "frames.csv: this manifest is empty"),
        ("path,iso\n", "frames.csv: this manifest has no rows"),
        (
            "paht,iso\na.exr,1",
            r"row 1: there is no column 'path' .did you mean 'paht'..; found: pa",
        ),
        ("path;iso\na.exr;1", "no column 'path'.*; columns are separated by commas"),
        ("path,iso,iso\n", "row 1: there are two columns 'iso'"),
        ("path,,iso\n", "row 1: column 2 has no name"),
        ("path,isoo\n", "row 1: unknown column 'isoo' .*mean 'iso'.*, or stage.parameter"),
        ("path,skips\n", "row 1: unknown column 'skips'"),
        ("path,mosaic\n", "row 1: mosaic is not a column, .*; use mosaic.PARAMETER"),
        (
            "path,sensr_noise.a\n",
            "row 1: sensr_noise.a: unknown stage 'sensr_noise' .*sensor_noise",
        ),
        ("path,sensor_noise.aa\n", "row 1: unknown parameter of sensor_noise 'aa'"),
        ("path,output.quality\n", "row 1: unknown key of output 'quality' .*jpeg_quality"),
        ("path,iso\n\na.exr\n", r"row 3: found 1 cells, but there are 2 columns .path, iso."),
        ("path,iso\na.exr,1,2\n", "row 2: found 3 cells, but there are 2 columns"),
        (
            'path,iso\n"a\nb.exr",1\n"c.exr,2',
            "row 4: this is not valid CSV: unexpected end of data",
        ),
        ('path,iso\n"a\nb.exr",1\nc.exr', "row 4: found 1 cells"),
        ('path\n"a"b\n', "row 2: this is not valid CSV"),
        ("path,iso\n,100\n", "row 2: path: found '', but expected the path of an image"),
        ("path\na/\n", "row 2: path: found 'a/', but expected the path of an image"),
        ("path\n..\n", "row 2: path: found '..', but expected the path of an image"),
        ("path\na\0b\n", "row 2: path: found .*not contain NUL"),
        (b"path\na.exr\n\xff.exr\n", "frames.csv, line 3: this is not UTF-8"),
        (
            "path,frames\na.exr,0\n",
            "row 2: frames: found 0, but expected a whole number from 1 to 1",
        ),
        ("path,frames\na.exr,2.5\n", "row 2: frames: found 2.5"),
        ("path,frames\na.exr,true\n", "row 2: frames: found True"),
        ("path\nx/a.exr\nb.exr\nx/a.exr\n", "row 4: .*same outputs as row 2, x/a; .*called name"),
        ("path\na.exr\na.hdr\n", "row 3: this row would write the same outputs as row 2, a"),
        (
            "path,frames\na,0\nb,1\nc,x\nd,-1\n",
            "row 2: frames: found 0.*; 2 more rows are also wrong",
        ),
        ("path,frames\na,0\nb,0\n", "row 2: frames: found 0.*; 1 more row is also wrong"),
        *(
            (f"path,name\na.exr,{name}\n", "row 2: name: found .*a path in the output directory")
            for name in ("/x", "../x", "a/../../x", "a/..", "..", ".", "a//b", "x/", "./x", "a/./b")
        ),
        *(
            (
                f"path,name\na.exr,{name}\n",
                "row 2: name: found .* not contain a backslash, .* choose another",
            )
            for name in (".hidden", ".clpipe.lock", "a/.b", "a\\..\\evil", "~/evil", "a/~b/c")
        ),
    ],
)
def test_a_csv_that_is_wrong(manifest, text, message):
    with pytest.raises(RequestError, match=message):
        manifest(text)


@pytest.mark.parametrize("name", ["..\\evil", "a\\..\\evil", "C:evil", "C:/evil", "//host/share/x"])
def test_a_name_stays_in_the_output_folder_on_windows(monkeypatch, name):
    windows = SimpleNamespace(sep="\\", path=ntpath)
    monkeypatch.setattr("clpipe.inputs.manifest.os", windows)
    with pytest.raises(RequestError, match="a path in the output directory"):
        check_output_name(name)
    check_output_name("a/b.c")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "row 2: this is not valid JSON: .* at character 2"),
        ("[1]", r"row 2: found \[1\], but expected an object"),
        ('{"path": "b.exr", "iso": NaN}', "row 2: this is not valid JSON: NaN is not"),
        ('{"path": "b.exr", "iso": -Infinity}', "row 2: this is not valid JSON: -Infinity is not"),
        ('{"path": "b.exr", "iso": 1, "iso": 2}', "row 2: 'iso' occurs twice"),
        (
            '{"path": "b.exr", "exposure": {"ev": 1}, "exposure.ev": 2}',
            "row 2: 'exposure.ev' occurs twice",
        ),
        ('{"iso": 100}', "row 2: path: found '', but expected the path of an image"),
        ('{"path": 3}', "row 2: path: found 3, but expected text"),
        ('{"path": "b.exr", "name": 3}', "row 2: name: found 3, but expected text"),
        ('{"path": "b.exr", "name": "\\ud800"}', "row 2: name: .*that UTF-8 can encode"),
        ('{"path": "b.exr", "name": "a\\u0000"}', "row 2: name: .*not contain NUL"),
        ('{"path": "b.exr", "frames": "3"}', "row 2: frames: found '3'"),
        ('{"path": "b.exr", "isoo": 3}', "row 2: unknown column 'isoo'"),
        ('{"path": "b.exr", "exposure": 3}', "row 2: exposure is not a column"),
        ('{"path": "b.exr", "exposure": {"e": 3}}', "row 2: unknown parameter of exposure 'e'"),
        ('{"path": "b.exr", "skips": ["denoise"]}', "row 2: unknown column 'skips'"),
        ('{"path": "b.exr", "iso": ' + "[" * 100_000, "row 2: this is not valid JSON"),
        ('{"path": "b.exr", "iso": ' + "1" * 5000 + "}", "row 2: this is not valid JSON"),
    ],
)
def test_a_jsonl_that_is_wrong(manifest, line, message):
    with pytest.raises(RequestError, match=message):
        manifest('{"path": "a.exr"}\n' + line, "frames.jsonl")


def test_a_manifest_that_is_not_there(tmp_path):
    with pytest.raises(RequestError, match=r"no.csv: there is no such file"):
        read_manifest(tmp_path / "no.csv")
    with pytest.raises(
        RequestError, match="this manifest cannot be read: it is a folder, not a file"
    ):
        read_manifest(tmp_path)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ("iso\nhigh", "row 2: iso: found 'high', but expected a number"),
        ("iso\nNaN", "row 2: iso: found 'NaN', but expected a number"),
        ("iso\nnan", "row 2: iso: found nan, but expected a number up to"),
        ("iso\n50", "row 2: iso: found 50, but camera sony-a7r2 goes from 100 to 25600"),
        ("iso\n1" + "0" * 400, "row 2: iso: found 10+, but expected a number up to"),
        ("iso\n" + "1" * 5000, "row 2: iso: found '1+.*1', but expected a number"),
        ("iso\n" + "[" * 5000, "row 2: iso: found .*but expected a number"),
        ("seed\n1.5", "row 2: seed: found 1.5, but expected a whole number"),
        ('seed\n"{choice=[1, 2]}"', "row 2: seed: found .*cannot be drawn"),
        ("camera\nsony-a7r9", "row 2: unknown camera 'sony-a7r9': .*most similar: sony-a7r"),
        ("camera\n7", "row 2: camera: found 7, but expected text"),
        ("camera\nno.toml", "row 2: .*/no.toml: there is no such file"),
        ("sensor_noise.a\nmuch", "row 2: sensor_noise.a: found 'much': .*number"),
        ("sensor_noise.a\nnan", "row 2: sensor_noise.a: found nan: .*finite"),
        ("sensor_noise.a\n2", "row 2: sensor_noise.a: found 2.*less than or equal to 1"),
        ("sensor_noise.a\n1" + "0" * 400, "row 2: sensor_noise.a: found 10+.*"),
        ('sensor_noise.a\n"{uniform=[0,2]}"', "row 2: sensor_noise.a: found 2.*less than"),
        ("demosaic.method\nbiliner", "row 2: demosaic.method: unknown method .*'bilinear'"),
        ("picture_noise.sigma\n0.1", "row 2: unknown parameter of picture_noise .none. 'sigma'"),
        ("mosaic_denoise.size\n5", "row 2: unknown stage in this chain 'mosaic_denoise'"),
        ("skip\n3", "row 2: skip: found 3, but expected a list of stage names"),
        ("skip\ndenoise nois", "row 2: skip: unknown stage 'nois'"),
        ("denoise_2.luma_strength\n5", "row 2: unknown stage in this chain 'denoise_2'"),
    ],
)
def test_a_row_whose_values_are_wrong(manifest, cells, message):
    header, cell = cells.split("\n")
    rows = manifest(f"path,{header}\na.exr,{cell}\n")
    with pytest.raises(RequestError, match=message):
        check_rows(rows, DEFAULT)


def test_what_is_wrong_in_several_rows(manifest):
    rows = manifest("path,iso\na,100\nb,50\nc,x\nd,800\n")
    with pytest.raises(RequestError, match=r"row 3: iso: found 50.*; 1 more row is also wrong$"):
        check_rows(rows, DEFAULT)


def test_a_row_leaves_out_stages_and_noise(manifest):
    rows = manifest('path,skip\na,denoise noise\nb,"[""denoise""]"\nc,picture_noise\nd,\n')
    rows += manifest('{"path": "e", "skip": ["noise"]}', "frames.jsonl")
    loud = {"method": "iid_gaussian", "sigma": [0.1, 0.1, 0.1]}
    values = {"picture_noise": loud, "prnu": {"sigma": 0.01}, "skip": ["sharpen"]}
    request = Request.from_options(values=values)
    check_rows(rows, request.settings())
    chains = [request.for_image(row.key, row.values).chain() for row in rows]
    assert all(chain.settings.skip[0] == "sharpen" for chain in chains)
    noisy = [[step.name for step in chain.steps if step.adds_noise] for chain in chains]
    sensor = ["prnu", "sensor_noise", "row_noise"]
    both = [*sensor, "picture_noise"]
    assert noisy == [[], both, sensor, both, []]
    denoised = ["denoise" in [step.name for step in chain.steps] for chain in chains]
    assert denoised == [False, False, True, True, True]


def test_an_image_that_brings_its_own_camera_may_have_its_isos(manifest):
    rows = manifest("path,iso,denoise_2.luma_strength\na.ARW,50,5\n")
    assert check_rows(rows, DEFAULT, lambda path: path.suffix == ".ARW")[0].iso == 50


def test_a_row_completes_and_replaces_what_options_set(tmp_path, monkeypatch):
    (tmp_path / "noise.json").write_text(json.dumps(noise_report(0.02, 0.02, 0.02)))
    monkeypatch.chdir(tmp_path)  # files named by rows are relative to the manifest
    (tmp_path / "rows").mkdir()
    (tmp_path / "noise.json").rename(tmp_path / "rows" / "noise.json")

    def sigma(cells, **values):
        header, cell = cells
        (tmp_path / "rows" / "a.csv").write_text(f"path,{header}\na.exr,{cell}\n")
        [row] = read_manifest(tmp_path / "rows" / "a.csv")
        noise = {"method": "iid_gaussian", **values}
        request = Request.from_options(values={"picture_noise": noise})
        check_rows([row], request.settings())
        chain = request.for_image(row.key, row.values).chain()
        return chain.step_named("picture_noise").method.sigma

    measured = ("picture_noise.measured", "noise.json")
    assert sigma(measured) == (0.02, 0.02, 0.02)
    assert sigma(measured, sigma=0.1) == (0.02, 0.02, 0.02)
    own = ("picture_noise.sigma", "0.3")
    assert sigma(own, measured="rows/noise.json") == (0.3, 0.3, 0.3)
    with pytest.raises(RequestError, match="picture_noise: set sigma, or set measured"):
        sigma(("iso", "400"))


@pytest.mark.parametrize(
    "text",
    [
        "0",
        "-0",
        "+5",
        "007",
        "1.50",
        "1.",
        "-.5",
        "1_000",
        "0x10",
        "1e3",
        "12345678901234567890",
        "-0.0",
        "1.5.2",
        "٣",
        "00.5",
    ],
)
def test_a_plain_number_is_what_toml_says(text: str) -> None:
    try:
        expected = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        expected = float(text) if text in ("1.", "-.5") else text
    assert repr(toml_value(text)) == repr(expected)
