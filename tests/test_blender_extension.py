"""The Blender extension: as it is packed, what it asks of clpipe, and, where bpy is, in Blender."""

import importlib
import json
import subprocess
import sys
import time
import tomllib
import zipfile
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import click
import numpy as np
import pytest
from click.core import ParameterSource

import clpipe as package
from clpipe.camera.profile import DEFAULT_CAMERA, built_in_cameras
from clpipe.chain.files import built_in_configs
from clpipe.commands.main import main
from tests.conftest import ROOT
from tools.blender import extension as builder

pytestmark = pytest.mark.slow


def load(name, path):
    loader = SourceFileLoader(name, str(path))
    module = module_from_spec(spec_from_loader(name, loader))
    sys.modules[name] = module  # dataclasses look there
    loader.exec_module(module)
    return module


development = load("blender_development", ROOT / "tools" / "blender" / "source" / "development.py")

WHEELS = {
    "clpipe-0.1.0-py3-none-any.whl": "clpipe/__init__.py",
    "numpy-2.4.0-cp311-cp311-manylinux_2_28_x86_64.whl": "numpy/__init__.py",
    "openimageio-3.1.0-cp311-cp311-manylinux_2_28_x86_64.whl": "OpenImageIO/__init__.py",
}
SETTINGS = {"camera": "", "look": "default", "iso": 1600, "seed": 3, "keep_raw": False}


@pytest.fixture(scope="module")
def extension(tmp_path_factory):
    """The extension with empty wheels."""
    folder = tmp_path_factory.mktemp("extension")
    for name, file in WHEELS.items():
        with zipfile.ZipFile(folder / name, "w") as wheel:
            wheel.writestr(file, "")
    path = folder / "clpipe-blender.zip"
    builder.build(path, "3.11", sorted(folder.glob("*.whl")))
    return path


@pytest.fixture
def settings():
    """Return the panel's settings with some changes."""
    return lambda **changed: development.Settings(**SETTINGS | changed)


def test_manifest_says_what_is_packed(extension):
    with zipfile.ZipFile(extension) as packed:
        names = packed.namelist()
        record = tomllib.loads(packed.read("blender_manifest.toml").decode())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert record["schema_version"] == "1.0.0" and record["type"] == "add-on"
    assert record["id"] == "clpipe" and record["version"] == package.__version__
    assert record["license"] == [f"SPDX:{project['license']}"] and "LICENSE" in names
    assert (record["blender_version_min"], record["blender_version_max"]) == ("4.2.0", "5.1.0")
    assert len(record["tagline"]) <= 64 and record["tagline"][-1].isalnum()
    wheels = [name for name in names if name.endswith(".whl")]
    assert record["wheels"] == [f"./{name}" for name in wheels] == ["./wheels/" + min(WHEELS)]
    assert len(names) == len(set(names))


def test_what_blender_has_itself_is_not_put_in_its_place(extension):
    with zipfile.ZipFile(extension) as packed:
        names = packed.namelist()
    assert {"private/numpy/__init__.py", "private/OpenImageIO/__init__.py"} <= set(names)


def test_panel_offers_cameras_and_configurations(extension):
    with zipfile.ZipFile(extension) as packed:
        record = json.loads(packed.read("choices.json"))
    assert record["cameras"].keys() == built_in_cameras().keys()
    assert record["looks"] == list(built_in_configs()) and record["look"] in record["looks"]


def test_command_is_one_of_the_command_line(settings, tmp_path):
    chosen = settings(camera=DEFAULT_CAMERA, look="paper", keep_raw=True)
    renders = [development.Render(tmp_path / f"-{n}.exr", tmp_path, chosen) for n in range(2)]
    arguments = development.command(renders)
    run = main.get_command(click.Context(main), "run")
    context = run.make_context("run", arguments[arguments.index("run") + 1 :])
    explicit = ParameterSource.COMMANDLINE
    given = {n for n in context.params if context.get_parameter_source(n) is explicit}
    assert given == {"inputs", "output", "config", "camera", "iso", "seed", "format", "quiet"}
    assert context.params["inputs"] == tuple(str(render.path) for render in renders)


def test_renders_that_wait_are_developed_together(settings, write_exr, clpipe, tmp_path, capsys):
    pixels = np.full((24, 32, 3), 0.3, np.float32)
    paths = [write_exr(f"linear/f.{n}.exr", pixels * n) for n in (1, 2)]
    works = development.Development()
    for path in (*paths, paths[0]):
        works.add(development.Render(path, tmp_path, settings()))
    works.add(development.Render(paths[0], tmp_path, settings(camera="nonsense")))
    assert len(works) == 4
    assert works.finish() == tmp_path / "f.2.jpg" and len(works) == 0
    assert works.message.startswith("unknown camera 'nonsense'")
    assert capsys.readouterr().err == f"clpipe: {works.message}\n"
    clpipe("run", "linear", "-o", "again", "--iso", 1600, "--seed", 3)
    for n in (1, 2):
        assert (tmp_path / f"f.{n}.jpg").read_bytes() == Path(f"again/f.{n}.jpg").read_bytes()


def test_missing_wheels_are_said(settings, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    works = development.Development()
    works.add(development.Render(tmp_path / "a.exr", tmp_path, settings()))
    assert works.finish() is None
    assert "wheels of the extension are missing" in works.message


@pytest.fixture
def blender(extension, tmp_path, monkeypatch):
    """Blender with the extension and a small scene: the extension's module, and the scene."""
    bpy = pytest.importorskip("bpy", reason="needs bpy, in the extra blender")
    folder = tmp_path / "clpipe_extension"
    with zipfile.ZipFile(extension) as packed:
        packed.extractall(folder, [n for n in packed.namelist() if not n.startswith("private/")])
    monkeypatch.syspath_prepend(tmp_path)
    bpy.ops.wm.read_factory_settings()
    module = importlib.import_module(folder.name)
    module.register()
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", 1, "CPU"
    scene.render.resolution_x, scene.render.resolution_y = 48, 32
    scene.frame_end = 2
    scene.render.filepath = str(tmp_path / "shots" / "shot_")
    for name, value in {**SETTINGS, "enabled": True}.items():
        setattr(scene.clpipe, name, value)
    yield module, scene
    module.unregister()
    for name in [n for n in sys.modules if n.partition(".")[0] == folder.name]:
        del sys.modules[name]


def render(**options):
    import bpy

    bpy.ops.render.render(**options)


def test_blender_finds_nothing_wrong_with_the_manifest(extension):
    bpy = pytest.importorskip("bpy", reason="needs bpy, in the extra blender")
    folder = Path(bpy.utils.system_resource("SCRIPTS"), "addons_core", "bl_pkg", "cli")
    tool = [sys.executable, folder / "blender_ext.py", "validate", extension]
    done = subprocess.run(tool, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_animation_and_still_are_those_of_the_command_line(blender, clpipe, tmp_path):
    module, scene = blender
    scene.clpipe.keep_raw = True
    render(animation=True)
    shown = module.bpy.data.images["clpipe"]
    assert shown.filepath == str(tmp_path / "shots/clpipe/shot_0002.jpg")
    assert tuple(shown.size) == (48, 32) and shown.colorspace_settings.name == "sRGB"
    scene.frame_set(3)
    render()  # a still that Blender itself does not write
    assert shown.filepath.endswith("shot_0003.jpg") and module.development.message == ""
    formats = ("--format", "jpg", "--format", "dng")
    clpipe("run", "shots/clpipe/linear", "-o", "again", "--iso", 1600, "--seed", 3, *formats)
    for n in (1, 2, 3):
        for ending in ("jpg", "dng"):
            name = f"shot_000{n}.{ending}"
            again = Path("again", name).read_bytes()
            assert Path("shots/clpipe", name).read_bytes() == again, name
    shots = {p.name for p in Path("shots").iterdir()}
    assert shots == {"clpipe", "shot_0001.png", "shot_0002.png"}


def test_same_render_has_the_same_noise_and_other_settings_others(blender, tmp_path):
    _, scene = blender
    pictures = []
    for seed in (3, 3, 4):
        scene.clpipe.seed = seed
        render()
        pictures.append((tmp_path / "shots/clpipe/shot_0001.jpg").read_bytes())
    assert pictures[0] == pictures[1] != pictures[2]


@pytest.mark.parametrize("kind", ["JPEG", "TIFF", "OPEN_EXR", "FFMPEG"])
def test_output_settings_are_the_users_again(blender, kind):
    module, scene = blender
    image = scene.render.image_settings
    if hasattr(image, "media_type"):
        image.media_type = "VIDEO" if kind == "FFMPEG" else "IMAGE"
    image.file_format = kind
    names = ("file_format", "color_mode", "color_depth", "exr_codec", "color_management")
    before = [getattr(image, name) for name in names]
    with module.linear_exr(scene):
        assert image.file_format == "OPEN_EXR" and image.color_depth == "16"
        assert scene.render.frame_path(frame=7).endswith("shot_0007.exr")
    assert [getattr(image, name) for name in names] == before


def test_settings_are_in_the_blend(blender, tmp_path):
    module, scene = blender
    chosen = {**SETTINGS, "camera": "canon-5d3", "look": "paper", "keep_raw": True, "enabled": True}
    for name, value in chosen.items():
        setattr(scene.clpipe, name, value)
    path = str(tmp_path / "scene.blend")
    module.bpy.ops.wm.save_as_mainfile(filepath=path)
    module.bpy.ops.wm.read_factory_settings()
    assert not module.bpy.context.scene.clpipe.enabled
    module.bpy.ops.wm.open_mainfile(filepath=path)
    again = module.bpy.context.scene.clpipe
    assert {name: getattr(again, name) for name in chosen} == chosen


def test_rendering_goes_on_without_clpipe(blender, tmp_path, monkeypatch):
    module, scene = blender
    scene.clpipe.camera = "nonsense"
    render(animation=True)
    assert module.development.message.startswith("unknown camera 'nonsense'")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    render(write_still=True)
    assert "wheels of the extension are missing" in module.development.message
    scene.render.use_multiview = True
    render()
    assert "several views" in module.development.message
    assert "clpipe" not in module.bpy.data.images
    scene.clpipe.enabled = False
    render()
    assert module.development.message == ""
    shots = {p.name for p in (tmp_path / "shots").iterdir()}
    assert shots == {"clpipe", "shot_.png", "shot_0001.png", "shot_0002.png"}


def test_image_editors_show_the_picture_in_place_of_the_render(blender):
    module, _ = blender
    areas = module.bpy.context.window_manager.windows[0].screen.areas
    for area in areas[:2]:
        area.type = "IMAGE_EDITOR"
    other = module.bpy.data.images.new("other", 4, 4)
    areas[1].spaces.active.image = other
    render()
    assert areas[0].spaces.active.image == module.bpy.data.images["clpipe"]
    assert areas[1].spaces.active.image == other


def test_timer_shows_what_a_window_renders(blender, tmp_path):
    module, scene = blender
    scene.clpipe.enabled = False
    render()
    module.development.add(module.save_linear(scene))
    while len(module.development):
        assert module.check_progress() > 0
        time.sleep(0.05)
    shown = module.bpy.data.images["clpipe"].filepath
    assert shown == str(tmp_path / "shots/clpipe/shot_0001.jpg")


def test_panel_shows_each_setting_and_the_message(blender):
    module, scene = blender
    panel, context = MagicMock(), SimpleNamespace(scene=scene, region=SimpleNamespace(width=240))
    module.development.message = "unknown camera 'nonsense'; allowed: canon-5d2"
    module.RENDER_PT_clpipe.draw_header(panel, context)
    module.RENDER_PT_clpipe.draw(panel, context)
    calls = panel.mock_calls
    shown = {call.args[1] for call in calls if call[0].endswith(".prop")}
    assert shown == {*scene.clpipe.bl_rna.properties.keys()} - {"rna_type", "name"}
    texts = [call.kwargs["text"] for call in calls if call[0].endswith(".label")]
    assert " ".join(texts) == module.development.message and len(texts) > 1


def test_disabled_extension_leaves_nothing(blender):
    module, _ = blender
    before = len(module.bpy.app.handlers.render_post)
    module.unregister()
    assert not hasattr(module.bpy.types.Scene, "clpipe")
    assert len(module.bpy.app.handlers.render_post) == before - 1
    module.register()
