"""The examples in CONTRIBUTING.md and README.md, run as they stand there."""

import re
import subprocess
import sys
from dataclasses import replace

import pytest
from click.testing import CliRunner

from clpipe.camera.profile import load_camera
from clpipe.chain.chain import make_chain
from clpipe.chain.files import load_settings
from clpipe.chain.registry import load_stage_file
from clpipe.commands.main import main
from clpipe.engine.check import check_method
from clpipe.engine.device import Device
from tests.conftest import ROOT, STILL_LIFE, written

TEXT = (ROOT / "CONTRIBUTING.md").read_text()


def block(language: str) -> str:
    return re.search(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)[1]


def test_the_example_stage_works(device, tmp_path, monkeypatch):
    monkeypatch.setattr("clpipe.chain.registry._from_files", {})
    (tmp_path / "vignette.cl").write_text(block("c"))
    (tmp_path / "vignette.py").write_text(block("python"))
    stage = load_stage_file(tmp_path / "vignette.py")
    for any_device in (device, Device(replace(device.info, lanes=1))):
        result = check_method(any_device, stage, stage.methods[0])
        assert result.difference.samples > 1000
        assert result.passed, result


def test_the_commands_it_shows_work(tmp_path, monkeypatch):
    monkeypatch.setattr("clpipe.chain.registry._from_files", {})
    monkeypatch.chdir(tmp_path)
    (tmp_path / "vignette.cl").write_text(block("c"))
    (tmp_path / "vignette.py").write_text(block("python"))
    (tmp_path / "render.exr").write_bytes(STILL_LIFE.read_bytes())
    commands = [line.split()[1:] for line in block("sh").splitlines()]
    assert [command[0] for command in commands] == ["check", "stages", "run"]
    for command in commands:
        result = CliRunner().invoke(main, command, catch_exceptions=False)
        assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "render.jpg").is_file()


def test_the_commands_of_the_readme_on_noise_work(tmp_path):
    text = (ROOT / "README.md").read_text()
    text = text[text.index("## Noise that can be trusted") : text.index("## From Python")]
    blocks = [b for b in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) if "CR2" not in b]
    (tmp_path / "render.exr").write_bytes(STILL_LIFE.read_bytes())
    script = f'clpipe() {{ "{sys.executable}" -m clpipe "$@"; }}\n' + "".join(blocks)
    done = subprocess.run(["sh", "-eu", "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert load_camera(str(tmp_path / "again.toml")).noise(800).a == pytest.approx(
        1.5884e-4, rel=0.02
    )
    for name in ("noise.png", "again.png", "baseline/render.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_the_profile_in_the_readme_is_valid_and_complete(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (text,) = (block for block in blocks if "[[gain_stages]]" in block)
    (tmp_path / "mine.toml").write_text(text)
    camera = load_camera(str(tmp_path / "mine.toml"))
    assert camera.noise(400).a == pytest.approx(1.08 / (16383 - 512))
    left_out = type(camera).model_fields.keys() - camera.model_fields_set
    assert left_out == {"row_noise_ratio", "column_noise_ratio"}


def test_every_file_it_names_is_there():
    for name in re.findall(r"`((?:clpipe|kernels|tests|tools)/[\w./]+)`", TEXT):
        if "vignette" not in name and "<" not in name:
            assert (ROOT / name).exists(), name


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md"])
def test_every_link_leads_somewhere(name):
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / name).read_text()):
        assert target.startswith("https://") or (ROOT / target).exists(), target


def test_the_configurations_in_the_readme_are_valid(tmp_path):
    path = tmp_path / "pipeline.toml"
    chains = []
    for text in re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL):
        if "[[gain_stages]]" not in text:
            path.write_text(text)
            chains.append(make_chain(load_settings(str(path))))
    output, whole, drawn = chains
    assert output.settings.output.focal_length == 35
    assert whole.iso == 1600
    assert "row_noise" not in [step.name for step in whole.steps]
    assert {"iso", "sensor_noise.b"} < set(drawn.draws)


def test_the_samples_of_the_readme(tmp_path, monkeypatch, capsys):
    text = (ROOT / "README.md").read_text()
    (code,) = (b for b in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "Dataset" in b)
    (tmp_path / "renders").mkdir()
    (tmp_path / "renders" / "a.exr").symlink_to(STILL_LIFE)
    monkeypatch.chdir(tmp_path)
    exec(f"import clpipe\n{code}", {})
    assert capsys.readouterr().out.startswith("a.exr 0 0.00063")


def test_the_manifest_in_the_readme(clpipe, tmp_path):
    (table,) = re.findall(r"```csv\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (tmp_path / "frames.csv").write_text(table)
    (tmp_path / "render.exr").symlink_to(STILL_LIFE)
    clpipe("run", "frames.csv", "-o", "out")
    burst = [f"high.{name}.jpg" for name in ("frame0", "frame1", "truth")]
    made = ["drawn.jpg", *burst, "low/frame.0001.jpg"]
    assert [name for name in written(tmp_path / "out") if name.endswith(".jpg")] == made
