"""The documentation: every example runs as written, and every link has a target."""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec, module_from_spec, spec_from_file_location

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

import clpipe as package
from clpipe.camera.profile import built_in_cameras
from clpipe.chain.registry import all_stages
from clpipe.reference.panorama import CUBE
from tests.conftest import ROOT, STILL_LIFE, WRITTEN, written
from tests.dng import write_dng
from tests.markdown import RUN, PageRunner, blocks
from tools.pages import architecture, screens

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
WITH_EXAMPLES = [page for page in PAGES if any(block.language in RUN for block in blocks(page))]


# Pages whose commands are all run on the device: the first that readers try, and one whose pictures
# are compared with those of other processes.
ON_THE_DEVICE = {"README.md", "docs/getting_started.md", "docs/recipes/cluster.md"}


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def write(path, pixels, type_, channels=()):
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], type_)
    if channels:
        spec.channelnames = channels
    spec.attribute("DateTime", WRITTEN)
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec)
    assert file.write_image(np.ascontiguousarray(pixels, np.float32))
    assert file.close()


@pytest.fixture(scope="session")
def material(tmp_path_factory):
    """The files that examples need, as small as possible."""
    folder = tmp_path_factory.mktemp("material")
    file = oiio.ImageInput.open(str(STILL_LIFE))
    still_life = file.read_image("float")[..., :3]
    file.close()
    write(folder / "render.exr", still_life[280:440, 340:612], oiio.HALF)
    (folder / "renders").mkdir()
    for number in range(1, 5):
        part = still_life[100 * number : 100 * number + 64, 300:396]
        write(folder / "renders" / f"000{number}.exr", part, oiio.HALF)
    (folder / "faces").mkdir()
    for number, face in enumerate(CUBE):
        part = still_life[200:264, 100 * number : 100 * number + 64]
        write(folder / "faces" / f"room_{face}.exr", part, oiio.HALF)
    small = still_life[200:264, 300:396]
    lit, names = np.dstack([small, small / 2]), (*"RGB", *(f"Combined_LED.{c}" for c in "RGB"))
    write(folder / "street.exr", lit, oiio.HALF, names)
    write(folder / "render.png", small, oiio.UINT8)
    write(folder / "render16.tif", small, oiio.UINT16)
    write(folder / "photo.jpg", np.clip(small, 0, 1) ** (1 / 2.2), oiio.UINT8)
    write(folder / "mosaic.exr", 256 + 3800 * small[..., :1].clip(0, 1), oiio.FLOAT)
    # Patches from dark to bright, as a scene for calibration.
    steps = np.kron(np.linspace(0.01, 0.9, 24).reshape(4, 6), np.ones((60, 60)))
    write(folder / "scene.exr", np.repeat(steps[..., None], 3, axis=2), oiio.HALF)
    write(folder / "black.exr", np.zeros((240, 360, 3)), oiio.HALF)
    dn = np.random.default_rng(0).integers(600, 9000, (64, 96))
    write_dng(folder / "IMG_0001.dng", dn)
    dump = np.random.default_rng(1).integers(600, 9000, (512, 768))
    (folder / "frame.raw").write_bytes(dump.astype("<u2").tobytes())
    return folder


@pytest.fixture
def run_page(material, tmp_path, clpipe, monkeypatch):
    """Run every block of a page in a new folder, and return the folder."""
    shutil.copytree(material, tmp_path, dirs_exist_ok=True)
    monkeypatch.syspath_prepend(tmp_path)
    modules = set(sys.modules)

    def run(page):
        runner = PageRunner(tmp_path, clpipe, numpy=name_of(page) not in ON_THE_DEVICE)
        for block in blocks(page):
            runner.run(block)
        return tmp_path

    yield run
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


def burst_from_the_manifest(folder):
    burst = [f"high.{name}.jpg" for name in ("frame0", "frame1", "truth")]
    made = ["drawn.jpg", *burst, "low/frame.0001.jpg"]
    assert set(made) < set(written(folder / "out"))


def the_figures_that_went_in(folder):
    again = package.Pipeline(camera=str(folder / "again.toml"), iso=800).chain.noise
    true = package.Pipeline(iso=800).chain.noise
    assert again.a == pytest.approx(true.a, rel=0.05)


def the_plot_of_noise(folder):
    assert (folder / "noise.png").stat().st_size > 10_000


def the_camera_that_was_simulated(folder):
    for iso in (100, 800):
        again = package.Pipeline(camera=str(folder / "my_camera.toml"), iso=iso).chain.noise
        true = package.Pipeline(iso=iso).chain.noise
        assert again.a == pytest.approx(true.a, rel=0.05)
        assert again.b == pytest.approx(true.b, rel=0.05)
    found = package.Pipeline(camera=str(folder / "my_camera.toml")).chain.camera
    assert found.prnu == pytest.approx(0.005, rel=0.05)


def the_drawn_values(folder):
    header, *rows = (folder / "dataset.csv").read_text().splitlines()
    assert header == "picture,iso,ev,a,b"
    assert [row.split(",")[0] for row in rows] == [f"000{n}.jpg" for n in range(1, 5)]
    assert len({row.split(",")[1] for row in rows}) == 4


def the_whole_in_shards(folder):
    whole = {name: (folder / "whole" / name).read_bytes() for name in written(folder / "whole")}
    assert len(whole) == 8
    for name, made in whole.items():
        assert (folder / "out" / name).read_bytes() == made
        if find_spec("distributed"):
            assert (folder / "dask" / name).read_bytes() == made
    array = [name for name in written(folder / "array") if name.endswith(".jpg")]
    assert array == ["0003.jpg"]


def the_pictures_of_the_pipe(folder):
    with package.Stream(transfer="srgb", iso=800) as stream:
        shots = [stream(np.full((72, 128, 3), 20 * step, np.uint8)) for step in range(10)]
    for shot in shots:
        with Image.open(folder / f"{shot.index:06}.png") as picture:
            assert np.array_equal(picture, shot.image)
    assert len((folder / "frames.jsonl").read_text().splitlines()) == len(shots)
    assert not (folder / "000010.png").exists()


# What is checked of a page's files beyond that its commands succeed.
CHECKS = {
    "docs/batches.md": burst_from_the_manifest,
    "docs/calibrating.md": the_figures_that_went_in,
    "docs/measuring.md": the_plot_of_noise,
    "docs/recipes/blender.md": the_drawn_values,
    "docs/recipes/cluster.md": the_whole_in_shards,
    "docs/recipes/real_camera.md": the_camera_that_was_simulated,
    "docs/robotics.md": the_pictures_of_the_pipe,
}


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_EXAMPLES, ids=name_of)
def test_the_examples_work(page, run_page, forget_stage_files):
    folder = run_page(page)
    if check := CHECKS.get(name_of(page)):
        check(folder)


def test_the_profile_is_complete(tmp_path):
    (text,) = (b.text for b in blocks(DOCS / "noise.md") if b.title == "mine.toml")
    (tmp_path / "mine.toml").write_text(text)
    camera = package.Pipeline(camera=str(tmp_path / "mine.toml")).chain.camera
    assert camera.noise(400).a == pytest.approx(1.08 / (16383 - 512))
    left_out = type(camera).model_fields.keys() - camera.model_fields_set
    ratios = {"row_noise_ratio", "column_noise_ratio"}
    readouts = {
        "readout_ratio",
        "readout_noise",
        "photodiode_ratio",
        "photodiode_crosstalk",
    }  # of sensors that read an exposure twice
    optional = {"aliases", "pixel_pitch", "tukey_lambda", "sensitivities"}
    assert left_out == optional | ratios | readouts


def test_slurm_in_the_recipe_is_the_one_in_the_tools():
    (text,) = (b.text for b in blocks(DOCS / "recipes" / "cluster.md") if b.title == "array.sh")
    script = (ROOT / "tools" / "examples" / "slurm_array.sh").read_text()
    for line in text.splitlines():
        assert line in script.splitlines()


def test_the_readme_is_short():
    assert (ROOT / "README.md").stat().st_size <= 6500


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_each_block_says_what_it_is(page):
    text = page.read_text()
    assert len(re.findall(r"^```", text, re.MULTILINE)) == 2 * len(blocks(page))


@pytest.fixture(scope="module")
def hook():
    spec = spec_from_file_location("docs_hook", ROOT / "tools" / "pages" / "docs_hook.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def generated(hook):
    return hook.pages()


def test_every_stage_is_documented(hook, generated):
    page = generated["stages.md"]
    for stage in hook.all_stages().values():
        for method in stage.methods:
            start = page.index(f"### {method.method} {{ #{stage.name}-{method.method} }}\n")
            part = page[start : page.find("\n### ", start + 1)]
            for name, field in method.model_fields.items():
                assert f"| `{name}` |" in part
                assert field.description in part
            assert f"kernels/{method.kernel}.cl" in part or not method.kernel
            assert ">>>" not in part


def test_every_camera_and_configuration_is_documented(generated):
    for page in ("cameras.md", "configurations.md"):
        names = re.findall(r"^## (\S+)$", generated[page], re.MULTILINE)
        assert len(names) >= 4
        assert names == sorted(names)
    assert "photonstophotos" in generated["cameras.md"]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_every_link_leads_somewhere(page, generated):
    for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if link.startswith("https://"):
            continue
        target, _, anchor = link.partition("#")
        path = (page.parent / target).resolve() if target else page
        made = generated.get(path.relative_to(DOCS).as_posix()) if DOCS in path.parents else None
        assert made is not None or path.exists(), link
        if anchor:
            assert anchor in anchors(made or path.read_text()), link


def anchors(text):
    """Return the anchors of a page by MkDocs: headings after an empty line, and objects."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    found = re.findall(r"^::: (\S+)$", text, re.MULTILINE)
    for heading in re.findall(r"(?:^|\n\n)#+ (.+)", text):
        title, _, named = heading.partition(" { #")
        words = re.sub(r"[^\w\s-]", "", title.lower()).split()
        found.append(named.removesuffix(" }") or "-".join(words))
    return found


@pytest.mark.parametrize("name", architecture.PICTURES)
def test_the_pictures_of_the_architecture_are_those_of_the_code(name):
    drawn = architecture.PICTURES[name]()
    assert (DOCS / name).read_text("utf-8") == drawn, "run tools/run pages architecture"


def test_the_readme_counts_what_there_is():
    text = (ROOT / "README.md").read_text()
    counts = {int(n): what for n, what in re.findall(r"- \*\*(\d+) (\w+)\*\*", text)}
    assert counts == {len(built_in_cameras()): "cameras", len(all_stages()): "stages"}


@pytest.mark.parametrize("name", ["screen_report", "screen_explore", "explore_iso"])
def test_screenshots_show_the_present_pages(name):
    with Image.open(DOCS / f"{name}.webp") as picture:
        assert picture.info["xmp"].decode() == screens.pages_digest(), "run tools/run pages screens"


def test_the_architecture_counts_its_packages():
    count = sum(map(len, architecture.layers()))
    assert f"clpipe has {count} packages" in (DOCS / "architecture.md").read_text("utf-8")


@pytest.mark.slow
def test_the_site_builds(tmp_path):
    """The site builds like with tools/docs; a dead link, anchor or name is an error."""
    pytest.importorskip("mkdocs", reason="needs MkDocs, in the extra docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "-d", tmp_path]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in ("stages", "cli", "api", "first_steps", "recipes/cluster"):
        assert (tmp_path / f"{page}.html").is_file()


@pytest.mark.slow
def test_the_notebook_runs(tmp_path, material):
    """Run the code cells in order in one process."""
    path = DOCS / "first_steps.ipynb"
    assert path.stat().st_size < 300_000
    cells = json.loads(path.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5
    shutil.copytree(material, tmp_path, dirs_exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    command = [sys.executable, "-c", "\n".join(code)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
