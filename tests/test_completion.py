"""What the shell completes, and that listing and completing commands stays light."""

import ast

import pytest
from click.shell_completion import ShellComplete

from clpipe.commands.main import COMMANDS, main, summary
from clpipe.stages import DEFAULT_CHAIN
from tests.conftest import run_python

pytestmark = pytest.mark.slow


def completed(*words):
    """The completions of the last word, with those before it on the command line."""
    *before, last = words
    shell = ShellComplete(main, {}, "clpipe", "_CLPIPE_COMPLETE")
    return [(item.type, item.value) for item in shell.get_completions(before, last)]


def values(*words):
    assert all(kind == "plain" for kind, _ in completed(*words))
    return [value for _, value in completed(*words)]


@pytest.mark.parametrize("words", [("run", "--camera"), ("cameras",), ("stages", "--camera")])
def test_cameras(words):
    assert values(*words, "nikon-d8") == ["nikon-d800", "nikon-d850"]
    assert values(*words, "Nikon D8") == ["nikon-d800", "nikon-d850"]
    assert values(*words, "A7 II") == ["sony-a7m2"]


OF_STAGES = "run --skip", "run --start-at", "plan --until", "run --keep", "stages", "check mosaic"


@pytest.mark.parametrize("words", OF_STAGES)
def test_stages(words):
    assert values(*words.split(), "demo") == ["demosaic"]
    assert set(DEFAULT_CHAIN) <= set(values(*words.split(), ""))


NUMBERS = ("method", "bits", "black_level", "white_level", "result_bits", "knots")


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (("c",), ["compare", "cameras", "calibrate", "check"]),
        (("run", "-c", "brooks"), ["brooks2019"]),
        (("run", "--stages", "exposure,mosaic,dem"), ["exposure,mosaic,demosaic"]),
        (("plan", "--keep", "a"), ["all"]),
        (("bench", "--methods", "den"), ["denoise"]),
        (("bench", "--methods", "prn"), []),  # has one method
        (("run", "--set", "expo"), ["exposure."]),
        (("run", "--set", "quantize."), [f"quantize.{name}=" for name in NUMBERS]),
        (("run", "--set", "gamma.method=s"), ["gamma.method=srgb"]),
        (("run", "--set", "nothing."), []),
        (("run", "--stage-file", "/gone.py", "--skip", "dem"), []),  # and no traceback
    ],
)
def test_names(words, found):
    assert values(*words) == found


def test_files():
    assert completed("run", "-c", "mine") == [("file", "mine")]
    assert completed("run", "--camera", "./") == [("file", "./")]


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_has_one_sentence_in_the_list(name):
    text = summary(name)
    assert 10 < len(text) < 100
    assert text[0].isupper() and not text.endswith(".")


# What takes long to import, and which commands do without it.
HEAVY = ("numpy", "pydantic", "pyopencl", "OpenImageIO", "rich", "scipy", "matplotlib")


# In this order, in one process: each may need what those before it need.
IMPORTS = {
    "import clpipe.__main__": (),
    "from clpipe.commands.main import main; main(['--help'], standalone_mode=False)": (),
    "import clpipe.commands.cameras": ("numpy", "pydantic"),
    "import clpipe.commands.stages": ("numpy", "pydantic"),
    "import clpipe.commands.plan": ("numpy", "pydantic"),
    "import clpipe.commands.devices": ("numpy", "pydantic", "pyopencl"),
    "import clpipe.pipeline": ("numpy", "pydantic", "pyopencl"),
    "import clpipe.commands.match": {*HEAVY} - {"matplotlib"},
}


def test_what_is_not_needed_is_not_imported():
    print_heavy = f"print('found', [m for m in {HEAVY} if m in sys.modules])"
    program = "\n".join(["import sys", *(line for code in IMPORTS for line in (code, print_heavy))])
    lines = run_python("-c", program).stdout.splitlines()
    found = [line[6:] for line in lines if line.startswith("found ")]
    for (code, allowed), modules in zip(IMPORTS.items(), found, strict=True):
        assert set(ast.literal_eval(modules)) <= set(allowed), code
