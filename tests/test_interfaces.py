"""Messages speak in the interface that the user used: Python, or the command line."""

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
    ({"iso": (100, 100)}, "iso: found [100, 100], which lists 100", "--iso: found '100,100'"),
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
