"""The example in CONTRIBUTING.md, run as it stands there."""

import re

import pytest

from clpipe import codegen
from clpipe.check import check_method
from clpipe.config import make_chain, read_settings
from clpipe.device import Device
from clpipe.registry import all_stages
from tests.conftest import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text()


def block(language: str) -> str:
    return re.search(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)[1]


def test_the_example_stage_works(device, tmp_path, monkeypatch):
    (tmp_path / "lib").symlink_to(codegen.kernel_folder() / "lib")
    (tmp_path / "vignette.cl").write_text(block("c"))
    namespace: dict = {"__name__": "vignette"}
    exec(block("python"), namespace)
    stage = namespace["STAGE"]
    everything = {**all_stages(), stage.name: stage}
    monkeypatch.setattr("clpipe.codegen.kernel_folder", lambda: tmp_path)
    monkeypatch.setattr("clpipe.config.all_stages", lambda: everything)
    result = check_method(Device(device.info), stage, stage.methods[0])
    assert result.samples > 1000
    assert result.passed, result


def test_every_file_it_names_is_there():
    for name in re.findall(r"`((?:clpipe|kernels|tests|tools)/[\w./]+)`", TEXT):
        if "vignette" not in name:
            assert (ROOT / name).exists(), name


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_every_link_leads_somewhere(name):
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / name).read_text()):
        assert (ROOT / target).exists(), target


def test_the_configuration_in_the_readme_is_valid(tmp_path):
    path = tmp_path / "pipeline.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1])
    chain = make_chain(read_settings(path))
    assert chain.iso == 1600
    assert "row_noise" not in [step.name for step in chain.steps]
