"""Intel's CPU runtime, found where pip installs it."""

import os
from importlib.metadata import PackagePath
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings
from clpipe.engine import vendors
from clpipe.engine.bench import scene
from clpipe.engine.device import Device
from clpipe.engine.discovery import find_devices
from clpipe.engine.runner import Runner
from clpipe.engine.vendors import drivers_visible, intel_library

pytestmark = pytest.mark.slow


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Intel's package, and a system with one vendor, of the loader's folder ``/vendors``."""
    library = tmp_path / "lib" / "libintelocl.so"
    system = tmp_path / "vendors"
    for file, text in ((library, ""), (system / "gpu.icd", "libgpu.so\n")):
        file.parent.mkdir()
        file.write_text(text)
    listed = PackagePath("../lib/libintelocl.so")
    listed.dist = SimpleNamespace(locate_file=lambda path: tmp_path / "site" / path)
    monkeypatch.setattr(vendors, "files", lambda name: [PackagePath("a.txt"), listed])
    monkeypatch.setattr(vendors, "FOLDERS", (system, tmp_path / "nowhere"))
    for name in vendors.VARIABLES:
        monkeypatch.delenv(name, raising=False)
    return SimpleNamespace(runtime=library, system=system)


def test_it_is_seen_beside_the_systems(installed):
    with drivers_visible():
        folder = Path(os.environ["OCL_ICD_VENDORS"])
        texts = {file.read_text().strip() for file in folder.glob("*.icd")}
    assert texts == {"libgpu.so", str(installed.runtime)}
    assert "OCL_ICD_VENDORS" not in os.environ and not folder.exists()


@pytest.mark.parametrize("variable", vendors.VARIABLES)
def test_a_users_own_choice_stays(installed, monkeypatch, variable):
    monkeypatch.setenv(variable, "/mine")
    before = dict(os.environ)
    with drivers_visible():
        assert dict(os.environ) == before
    assert dict(os.environ) == before


def test_nothing_changes_without_the_package_or_where_it_is_found_anyhow(installed, monkeypatch):
    (installed.system / "intel.icd").write_text(f"{installed.runtime}\n")
    with drivers_visible():
        assert "OCL_ICD_VENDORS" not in os.environ
    (installed.system / "intel.icd").write_text("/opt/wrong/libintelocl.so\n")
    with drivers_visible():
        assert "OCL_ICD_VENDORS" in os.environ
    installed.runtime.unlink()
    assert intel_library() is None
    with drivers_visible():
        assert "OCL_ICD_VENDORS" not in os.environ


def test_the_raw_has_the_same_bits_on_all_cpus():
    cpus = [d for d in find_devices() if d.type == "CPU" and not d.problem]
    if len(cpus) == 1:
        pytest.skip("needs a second OpenCL runtime for CPUs, such as that of the extra intel")
    chain = make_chain(Settings(iso=3200))
    raws = [Runner(chain, Device(d), ("quantize",)).run(scene(333, 77), "k").kept for d in cpus]
    for raw in raws[1:]:
        assert np.array_equal(raw["quantize"], raws[0]["quantize"])
