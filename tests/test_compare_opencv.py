"""tools/compare/opencv.py and what it uses; the script itself only where OpenCV is installed."""

from argparse import ArgumentTypeError

import numpy as np
import pytest

from clpipe.batch.bench import Workload
from clpipe.chain.request import Request
from clpipe.images.jpeg import JpegEncoding, jpeg_encoding
from tools.compare import opencv as tool
from tools.compare import timing

pytestmark = pytest.mark.slow


def test_works_are_interleaved_and_preparation_is_not_timed(monkeypatch):
    calls, now = [], [0]

    def lasting(name, seconds):
        def work():
            calls.append(name)
            now[0] += seconds

        return work

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    works = {"a": lasting("a", 1), "b": lasting("b", 2)}
    assert timing.interleaved(works, 2, lasting("before", 10)) == {"a": [1, 1], "b": [2, 2]}
    assert calls == ["before", "a", "before", "b"] * 2


def test_ratios_are_computed_within_a_round():
    # Other load disturbed the second round: both works took ten times as long.
    row = timing.Comparison("w", 12.0, (1.0, 10.0, 1.0), {"x": (4.0, 40.0, 2.0)})
    assert row.ratios("x") == (3, 4, 4)
    assert row.cells() == ["w", "12", "3", "4.00", "3.00 4.00"]


@pytest.mark.parametrize("text", ["6000", "0x4", "ax4", "5x4", "2x4x6"])
def test_a_size_is_two_even_numbers(text):
    assert tool.size_of("6000x4000") == (6000, 4000)
    assert tool.load_of("3x6x4") == Workload(3, 6, 4)
    with pytest.raises(ArgumentTypeError, match=f"^found '{text}'; "):
        tool.size_of(text)


def test_what_is_missing_is_named(monkeypatch, capsys):
    monkeypatch.setattr(tool, "NEEDED", ("numpy", "no_such_module"))
    monkeypatch.setattr("sys.argv", ["compare_opencv"])
    assert tool.main() == 1
    assert (
        capsys.readouterr().err
        == "no_such_module: missing; .venv/bin/pip install -e '.[compare]'\n"
    )


@pytest.fixture
def script():
    pytest.importorskip("cv2", reason="needs OpenCV, in the extra compare")
    from tools.compare.opencv_chain import OpenCVChain

    return OpenCVChain(Request.from_options().chain())


def test_the_script_makes_the_same_picture_and_noise(script, device):
    alike = tool.likeness(device)
    assert alike.difference < 3
    assert alike.noise == pytest.approx(1, abs=0.05)


def test_bands_join_without_seams(script, monkeypatch):
    from tools.compare import opencv_chain

    monkeypatch.setattr(opencv_chain, "BAND", 64 * 40)
    monkeypatch.setattr(script, "expose", lambda light: np.rint(light[..., 0]).astype(np.uint16))
    light = np.random.default_rng(0).integers(500, 16000, (130, 64, 3)).astype(np.float32)
    assert abs(script.run_in_bands(light).astype(int) - script.run(light)).max() <= 1


def test_threads_draw_different_noise(script):
    from tools.compare.opencv_chain import pool

    grey = np.full((8, 8, 3), 0.2, np.float16)
    raws = []
    for _ in range(2):
        with pool(1) as threads:
            raws.append(threads.submit(script.expose, grey).result())
    assert not np.array_equal(*raws)


def test_both_make_the_same_files(script, device, tmp_path):
    files = tool.Files(device, Workload(3, 32, 16), tmp_path)
    encodings = []
    for work in (files.clpipe, lambda: files.opencv(bands=False), lambda: files.opencv(bands=True)):
        files.clear()
        work()
        pictures = sorted(files.out.glob("*.jpg"))
        assert [path.stem for path in pictures] == ["0", "1", "2"]
        encodings.append(jpeg_encoding(pictures[0]))
    assert encodings == [JpegEncoding(97, "4:2:2")] * 3
