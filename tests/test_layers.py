"""The house: imports point one way, and outside libraries have one door each."""

import ast

import pytest

from tests.conftest import ROOT

PACKAGE = ROOT / "clpipe"
# Lower ones first; a module imports only from lower levels.
LEVELS = [
    {"errors", "types", "suggest", "noise_model", "output", "printable"},
    {"reference", "memory"},
    {"camera", "draws", "statistics", "raw_dump", "exr_colour"},
    {"stage", "calibration", "luminance_chroma"},
    {"stages"},
    {"registry"},
    {"config"},
    {"manifest"},
    {"plan", "truth"},
    {"codegen", "shots"},
    {"tiles"},
    {"device"},
    {"run"},
    {"image_io", "raw_io", "check", "bench", "pipeline"},
    {"reentry", "dng", "jobs", "asked", "interrupt"},
    {"raw_entry", "target"},
    {"entrance", "sidecar", "output_folder", "measure"},
    {"batch", "dataset", "replay", "measure_plot", "calibration_frames"},
    {"run_log", "trace", "bench_batch", "webdataset", "cluster"},
    {"progress", "describe"},
    {"cli"},
]
LEVEL = {name: i for i, names in enumerate(LEVELS) for name in names}
DOORS = {
    "pyopencl": {"device"},
    "OpenEXR": {"luminance_chroma"},
    "OpenImageIO": {"image_io"},
    "PIL": {"image_io"},
    "click": {"cli"},
    "rich": {"cli", "progress"},
    "rawpy": {"raw_io"},
    "exifread": {"raw_io"},
    "matplotlib": {"calibration", "measure_plot"},
    "scipy": {"calibration"},
    "distributed": {"cluster"},
}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            if node.module == "clpipe":
                yield from (f"clpipe.{alias.name}" for alias in node.names)
            else:
                yield node.module


MODULES = sorted(p for p in PACKAGE.rglob("*.py") if p.name not in ("__init__.py", "__main__.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_one_way(path):
    own = path.relative_to(PACKAGE).with_suffix("").parts[0]
    for name in imports(path):
        head, *rest = name.split(".")
        if head == "clpipe" and rest and rest[0] in LEVEL and rest[0] != own:
            assert LEVEL[rest[0]] < LEVEL[own], f"{own} imports {name}"
        assert own in DOORS.get(head, {own}), f"{own} imports {name}"


def test_every_module_has_a_level():
    found = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in MODULES}
    assert found == set(LEVEL)
