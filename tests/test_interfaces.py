"""Messages speak in the interface that the user used: Python, or the command line."""

import ast
import re
import warnings
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

import clpipe as package
from clpipe.chain.keys import KEYS
from clpipe.chain.options import OPTIONS
from clpipe.chain.python_words import KEY_BY_OPTION, python_words


@pytest.fixture
def files(write_exr, clpipe):
    write_exr("in/a.exr", np.full((16, 24, 3), 0.2))
    pixels = oiio.ImageBufAlgo.fill((0.2, 0.3, 0.4), oiio.ROI(0, 24, 0, 16, 0, 1, 0, 3))
    Path("png").mkdir()
    assert pixels.write("png/a.png", "uint8")


REQUESTS = [
    ({"output": "memory://b"}, "add webdataset=N", "add --webdataset N"),
    ({"codec": "h264"}, "codec: this option needs a clip; use output='NAME.mp4'", "--codec: this"),
    ({"augment": True}, "patch=clpipe.Patches(64, augment=True)", "add --patch SIZE"),
    ({"iso": [100, 100]}, "iso: found [100, 100], which lists 100", "--iso: found '100,100'"),
    ({"poses": "none.json"}, "poses none.json", "none.json"),
    ({"shard": "3/2"}, "shard: found '3/2'", "--shard: found '3/2'"),
    ({"until": "mosaic", "start_at": "gamma"}, "exchange start_at and until", "--start-at and"),
    ({"carry": ["Depth:no"]}, "carry Depth:no", "--carry Depth:no"),
]


@pytest.mark.parametrize(("options", "in_python", "in_a_command"), REQUESTS)
def test_a_request_is_rejected_in_its_words(files, clpipe, options, in_python, in_a_command):
    with pytest.raises(package.RequestError) as caught:
        package.run("in", **{"output": "o", **options})
    assert in_python in str(caught.value)
    assert "--" not in str(caught.value)
    words = ["run", "in"]
    for name, value in {"output": "o", **options}.items():
        words.append(f"--{name.replace('_', '-')}")
        if value is not True:
            words.append(",".join(map(str, value)) if isinstance(value, list | tuple) else value)
    assert in_a_command in " ".join(clpipe(*words, status=2).stderr.split())


def test_an_image_is_rejected_in_its_words(files, clpipe):
    (outcome,) = package.run("png/a.png", "o", device="numpy")
    assert "add transfer='srgb' or transfer='linear'" in outcome.error
    assert "use config='unprocess'" in outcome.error and "--" not in outcome.error
    stderr = " ".join(clpipe("run", "png/a.png", "-o", "o", status=1).stderr.split())
    assert "add --transfer srgb or --transfer linear" in stderr and "use -c unprocess" in stderr
    with pytest.raises(package.ClpipeError) as caught:
        package.Dataset("png", device="numpy")
    assert "add transfer='srgb'" in str(caught.value) and "--" not in str(caught.value)


def test_a_pipeline_speaks_python(files):
    with pytest.raises(package.RequestError) as caught:
        package.Pipeline(start_at="gamma", until="mosaic")
    assert "exchange start_at and until" in str(caught.value)
    with warnings.catch_warnings(), pytest.raises(package.ImageError) as caught:
        package.Pipeline(device="numpy").process(np.zeros((8, 8, 3), np.uint8))
    assert "use the configuration 'unprocess'" in str(caught.value)


@pytest.mark.parametrize("name", sorted({*OPTIONS, *KEYS}))
def test_every_option_has_words_in_python(name):
    option = name.replace("_", "-")
    assert KEY_BY_OPTION[option].name == name
    assert python_words(f"remove --{option}; see --{option}") == f"remove {name}; see {name}"
    assert python_words(f"clpipe run --{option}") == f"clpipe run --{option}"
    assert not re.search(r"--\w", python_words(f"--{option}: found 3"))


IMAGE = np.full((8, 12, 3), 0.2, np.float32)


@pytest.mark.parametrize(
    ("image", "options", "message"),
    [
        ([[0.2]], {}, "^image is a list, but an array is expected. Pass numpy.asarray"),
        ("a.exr", {}, "^image is a str.* Pass a NumPy array. For files, use clpipe.run"),
        (None, {}, "^image is a NoneType, but an array is expected. Pass a NumPy array$"),
        (IMAGE[..., 0], {}, r"^the image has shape \(8, 12\)"),
        (IMAGE[..., 0], {"key": "a"}, r"^a: the image has shape \(8, 12\)"),
        (IMAGE, {"overscan": 3}, r"found overscan \(3,\); expected four numbers"),
    ],
)
def test_wrong_images_of_a_pipeline(image, options, message):
    with pytest.raises(package.ImageError, match=message):
        package.Pipeline(device="numpy").process(image, **options)


def test_wrong_arguments_in_python(files):
    camera = package.Pipeline(device="numpy")
    with pytest.raises(package.ImageError, match="found a tuple of 3; expected an image and its"):
        list(camera.process_many([(IMAGE, "a", "b")]))
    samples = package.Dataset("in", device="numpy")
    for call in (samples.set_epoch, samples.load_state_dict):
        with pytest.raises(package.RequestError, match=r"found (epoch|state) 'a'; expected"):
            call("a")
    Path("a.tar").write_bytes(b"none")
    with pytest.raises(package.ImageError, match=r"a.tar: cannot be read; it is damaged, or not a"):
        next(iter(package.StreamingDataset("a.tar", device="numpy")))


def test_a_path_is_a_text(files):
    path = Path(package.built_in_cameras()["canon-6d"])
    assert package.Pipeline(camera=path, device="numpy").chain.camera.name == "canon-6d"
    assert package.load_camera(path).name == "canon-6d"


def test_warnings_point_at_the_call_of_the_user(files):
    camera = package.Pipeline(device="numpy")
    with pytest.warns(UserWarning, match="no step reads the depth") as caught:
        camera(IMAGE, "a", depth=IMAGE[..., 0])
    Path("in/b.exr").write_bytes(b"none")
    with pytest.warns(UserWarning, match="skipped: in/b.exr") as skipped:
        package.Dataset("in", on_error="skip", device="numpy")
    assert {each.filename for each in (*caught, *skipped)} == {__file__}


def test_an_archive_is_named_as_a_url(files, clpipe):
    Path("a.zip").write_bytes(b"none")
    assert "name zip://::FILE.zip" in clpipe("run", "a.zip", "-o", "o", status=2).stderr


@pytest.mark.parametrize(
    ("settings", "draw"),
    [
        ({"iso": [100, 6400]}, "iso={'log_uniform': [100, 6400]}"),
        ({"iso": [100, 800, 3200]}, "iso={'choice': [100, 800, 3200]}"),
        ({"camera": ["sony-a7r2", "canon-6d"]}, "camera={'choice': ['sony-a7r2', 'canon-6d']}"),
    ],
)
def test_a_list_instead_of_a_draw(settings, draw):
    with pytest.raises(package.RequestError) as caught:
        package.Pipeline(device="numpy", **settings)
    assert str(caught.value).endswith(f"; to draw it for each image, use {draw}")
    name, values = draw.split("=", 1)
    package.Pipeline(device="numpy", **{name: ast.literal_eval(values)})
