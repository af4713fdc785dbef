"""Users' own stages: from a file, and from an installed package."""

import ast
import itertools
import os
import re

import numpy as np
import pytest

from clpipe.base.cache import BoundedCache
from clpipe.chain import registry
from clpipe.chain.families import ComputedChain
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import overlay, settings_from
from clpipe.engine.bands import Cpu
from clpipe.engine.codegen import write_kernel
from clpipe.engine.plan import make_plan
from clpipe.engine.runner import Runner
from tests.conftest import ROOT, STILL_LIFE, cli_output, run_python
from tests.test_contributing import block
from tests.test_families import assert_equal, made

PYTHON, OPENCL = block("python"), block("c")


@pytest.fixture
def clpipe(forget_stage_files):
    """Run clpipe with no stage file loaded yet."""
    return cli_output


@pytest.fixture
def stage_file(tmp_path):
    (tmp_path / "vignette.py").write_text(PYTHON)
    (tmp_path / "vignette.cl").write_text(OPENCL)
    return tmp_path / "vignette.py"


@pytest.mark.slow
def test_a_stage_file_is_a_stage_like_any_other(clpipe, stage_file, tmp_path):
    assert "vignette" in clpipe("stages", "--stage-file", stage_file)
    assert "focal_length" in clpipe("stages", "vignette", "--stage-file", stage_file)
    chain = ("--stages", "exposure,vignette", "--stage-file", stage_file)
    assert "exposure..vignette" in clpipe("plan", *chain)
    out = tmp_path / "out"
    clpipe("run", STILL_LIFE, "-o", out, *chain, "--format", "png", "--keep", "exposure")
    assert (out / "still_life.png").is_file()


def test_a_configuration_names_stage_files_relative_to_itself(clpipe, stage_file, tmp_path):
    config = tmp_path / "pipeline.toml"
    config.write_text('stage_files = ["vignette.py"]\nstages = ["exposure", "vignette"]\n')
    assert "exposure..vignette" in clpipe("plan", "-c", config)


def test_without_its_file_the_stage_is_unknown(clpipe):
    assert "unknown stage 'vignette'" in clpipe("plan", "--stages", "vignette", status=2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("class CosineFourth(Method):", "class CosineFourth(Method:"), r"vignette.py, line \d+: "),
        (("STAGE = ", "STAG = "), "vignette.py: STAGE is missing"),
        (("import numpy as np", "import numpi as np"), r"vignette.py, line 5: ModuleNotFound"),
        (
            ('"vignette", "Darken', '"denoise", "Darken'),
            "'denoise', but another stage has this name",
        ),
        (('"vignette", "Darken', '"denoise_2", "Darken'), "does not end in a digit"),
        (("(CosineFourth,)", "(CosineFourth)"), r"the methods of vignette must be a tuple"),
        (('    method: ClassVar = "cosine_fourth"\n', ""), "CosineFourth lacks method"),
        (("Kind.RGB, Kind.RGB", "Kind.RGB, Kind.RBG"), r"py, line \d\d: AttributeError: RBG"),
        (('"px", gt=0)', '"px", gtt=0)'), r"vignette.py, line \d\d: TypeError: .*gtt; limits are"),
        (('kernel: ClassVar = "vignette"', 'kernel: ClassVar = "vig"'), "vig.cl does not exist"),
        (("self.focal_length**-2", "1 / 0"), r"vignette.py, line \d\d: ZeroDivisionError"),
        (
            ('"scale": scale', '"scale": "x"'),
            "arguments.. returns 'x' as 'scale'; its type must be one of float, int, float32",
        ),
        (('"scale": scale', '"skale": scale'), "vignette needs the argument 'scale', but .*skale"),
        (('Pass("vignette"', 'Pass("vinette"'), "a pass calls the function vinette, but"),
    ],
)
def test_a_stage_file_with_a_mistake(clpipe, stage_file, change, message):
    text = PYTHON.replace(*change)
    assert text != PYTHON
    stage_file.write_text(text)
    chain = ("--stages", "exposure,vignette", "--stage-file", stage_file)
    output = clpipe("plan", *chain, status=2)
    assert "Traceback" not in output
    assert re.search(message, output), output


def test_a_reference_that_fails_is_named_with_its_line(clpipe, stage_file, tmp_path):
    stage_file.write_text(PYTHON.replace("np.indices(", "np.indexes("))
    chain = ("--stages", "exposure,vignette", "--stage-file", stage_file)
    out = tmp_path / "out"
    output = clpipe("run", STILL_LIFE, "-o", out, *chain, "--device", "numpy", status=1)
    assert re.search(r"stage vignette: .*vignette.py, line \d\d: AttributeError", output), output


def test_a_kernel_with_a_syntax_error_is_named_with_its_own_line(clpipe, stage_file, tmp_path):
    lines = OPENCL.splitlines()
    lines[4] = "    const vf fall = 1.0f + (dx * dx + dy * dy) * scal;"
    (tmp_path / "vignette.cl").write_text("\n".join(lines) + "\n")
    chain = ("--stages", "exposure,vignette", "--stage-file", stage_file)
    output = clpipe("run", STILL_LIFE, "-o", tmp_path / "out", *chain, status=2)
    assert f"{tmp_path}/vignette.cl: does not compile" in output
    assert f"{tmp_path}/vignette.cl:5:" in output
    assert "scal'" in output
    assert not list((tmp_path / "out").iterdir())


def renamed(stage_file, name):
    """Give the function of the example stage another name."""
    kernel = stage_file.with_suffix(".cl")
    kernel.write_text(kernel.read_text().replace("vignette(", f"{name}("))
    status = stage_file.stat()
    stage_file.write_text(stage_file.read_text().replace('"vignette", arg', f'"{name}", arg'))
    os.utime(stage_file, ns=(status.st_atime_ns, status.st_mtime_ns))  # as in the same second


@pytest.mark.parametrize(
    ("formula", "is_computed"),
    [
        ("1 / np.sqrt(self.focal_length) ** 4", True),
        ("1 / np.clip(np.hypot(self.focal_length, 3), 1, 1e6) ** 2", True),
        ("pure(math.gamma)(self.focal_length / 9)", True),
        ("math.gamma(self.focal_length / 9)", False),
    ],
)
def test_the_arguments_of_a_stage_are_computed_for_drawn_numbers(
    clpipe, stage_file, device, monkeypatch, formula, is_computed
):
    """Arguments, launches and pixels are those of a chain that is made for the numbers alone."""
    monkeypatch.setattr("clpipe.chain.families.FAMILIES", BoundedCache(64))
    imports = "import math\n\nfrom clpipe.stage import pure\n\nimport numpy as np"
    text = PYTHON.replace("self.focal_length**-2", formula).replace("import numpy as np", imports)
    stage_file.write_text(text)
    registry.load_stage_file(stage_file)
    image = np.random.default_rng(1).random((9, 21, 3), np.float32)
    general = settings_from({"stages": ["exposure", "vignette"]})
    for focal_length in (9.0, 12.5, 14.0, 15.25):
        settings = overlay(general, {"vignette": {"focal_length": focal_length}})
        chain, expected = make_chain(settings), made(settings, monkeypatch)
        assert_equal(chain, expected)
        sources = [
            [write_kernel(plan, launch, 8).source for launch in plan.launches]
            for plan in map(make_plan, (chain, expected))
        ]
        assert sources[0] == sources[1]
        images = [Runner(each, device).run(image, "a").image for each in (chain, expected)]
        assert np.array_equal(*images)
    assert isinstance(chain, ComputedChain)
    assert (chain.structure is not None) is is_computed  # whether no code of the stage runs again


@pytest.mark.parametrize(
    "name", ["bright_ROW", "ROW_of", "COLUMNS_gain", "src_image_gain", "src_tap2", "values_ROW"]
)
def test_names_that_contain_words_of_the_generator(clpipe, stage_file, name):
    """The source is that of another name, in all places where rows and launches have numbers."""

    def sources():
        registry._from_files.clear()
        registry.load_stage_file(stage_file)
        for stages in ("exposure,vignette,gamma", "vignette,optical_blur,vignette,denoise"):
            chain = make_chain(settings_from({"stages": stages.split(",")}))
            for cpu, lanes in itertools.product((None, Cpu(2, 1 << 19)), (1, 8)):
                plan = make_plan(chain, cpu=cpu)
                for launch in plan.launches:
                    yield re.sub(r"launch_\w+", "", write_kernel(plan, launch, lanes).source)

    before = [*sources()]
    assert any(re.search(r"src_image\d", text) for text in before)  # launches in bands have numbers
    renamed(stage_file, name)
    assert [*sources()] == [re.sub(r"\bvignette\(", f"{name}(", text) for text in before]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nearest", "clpipe's kernels/lib/lanes.h also defines this name"),
        ("exposure", "clpipe's kernels/exposure.cl also defines this name"),
        ("LANES", "clpipe uses this name"),
        ("first", "clpipe uses this name for a variable"),
        ("rgb", "clpipe uses this name for a variable"),
    ],
)
def test_a_function_with_a_name_of_clpipe_is_rejected(
    clpipe, stage_file, tmp_path, write_exr, name, reason
):
    renamed(stage_file, name)
    kernel = stage_file.with_suffix(".cl")
    render = write_exr("a.exr", np.full((24, 33, 3), 0.2, np.float32))
    options = ("--stages", "exposure,vignette", "--stage-file", stage_file)
    message = clpipe("run", render, "-o", tmp_path / "out", *options, status=(1, 2))
    assert f"{kernel}: it defines the function {name}, but {reason}" in message
    assert "Traceback" not in message and "rename the function" in message


def test_a_name_is_taken_by_another_file(clpipe, stage_file, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.py").write_text(PYTHON)
    (other / "vignette.cl").write_text(OPENCL)
    files = ("--stage-file", stage_file, "--stage-file", other / "mine.py")
    assert f"another stage has this name ({tmp_path})" in clpipe("stages", *files, status=2)


@pytest.mark.parametrize("name", ["no.py", "vignette.cl"])
def test_a_stage_file_that_is_none(clpipe, stage_file, tmp_path, name):
    assert name in clpipe("stages", "--stage-file", tmp_path / name, status=2)


def install(folder, python=PYTHON):
    package = folder / "lens_stages"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "vignette.py").write_text(python)
    (package / "vignette.cl").write_text(OPENCL)
    info = folder / "lens_stages-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lens-stages\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[clpipe.stages]\nvignette = lens_stages.vignette:STAGE\n"
    )


def run_with_package(folder, *arguments):
    return run_python("-m", "clpipe", *arguments, status=None, PYTHONPATH=f"{folder}:{ROOT}")


@pytest.mark.slow
def test_a_stage_of_an_installed_package(tmp_path):
    install(tmp_path)
    done = run_with_package(tmp_path, "plan", "--stages", "exposure,vignette")
    assert "exposure..vignette" in done.stdout, done.stderr
    assert "vignette" in run_with_package(tmp_path, "stages").stdout


@pytest.mark.slow
def test_a_package_whose_stage_cannot_be_loaded(tmp_path):
    install(tmp_path, PYTHON.replace("import numpy as np", "import numpi as np"))
    done = run_with_package(tmp_path, "stages")
    assert done.returncode == 2
    assert "package lens-stages" in done.stderr
    assert "numpi" in done.stderr
    assert "Traceback" not in done.stderr


# These names are not stages: a truth, an attribute of kept images, a kind, a key of cameras.json.
NO_STAGES = {
    ("chain/rendition.py", "mosaic"),
    ("chain/camera_info.py", "color_matrix"),
    ("inputs/kept.py", "sensor_noise"),
    ("explorer/view.py", "mosaic"),
    ("inputs/render_cameras.py", "distortion"),
    ("outputs/output_pictures.py", "distortion"),
}


def strings_of(path):
    """Return the strings in code except docstrings."""
    if path.suffix != ".py":
        return re.findall(r'"([^"\n]*)"|`([^`]*)`', path.read_text())
    tree = ast.parse(path.read_text())
    texts = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    return [
        (node.value,)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in texts
    ]


@pytest.mark.parametrize("package", ["chain", "inputs", "outputs", "explorer"])
def test_no_stage_is_known_by_its_name(package):
    """clpipe finds its own stages by their declarations, like users' stages."""
    folder = ROOT / "clpipe" / package
    names = [name for name, stage in all_stages().items() if stage.folder is None]
    parameter = re.compile(rf"\b({'|'.join(names)})\.[a-z_]+")
    found = [
        (path.relative_to(folder.parent).as_posix(), text)
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".py", ".js")
        for text in {text for groups in strings_of(path) for text in groups}
        if text in names or parameter.search(text)
    ]
    assert not {*found} - NO_STAGES
