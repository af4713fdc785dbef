"""Dead leaves images: their statistics, their truths, and datasets of them."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

import clpipe as package
from clpipe.base.errors import RequestError
from clpipe.scenes.leaves import FAR, NEAR, dead_leaves
from tests.conftest import written

NUMPY = ("--device", "numpy", "-c", "paper")


@pytest.fixture(scope="module")
def leaves():
    return dead_leaves(384, 256, seed=3)


def test_the_arguments_determine_the_image(leaves):
    again = dead_leaves(384, 256, seed=3)
    for name in ("image", "labels", "depth"):
        assert np.array_equal(getattr(leaves, name), getattr(again, name))
    for other in (dead_leaves(384, 256, 4), dead_leaves(384, 256, 3, index=1)):
        assert (other.labels != leaves.labels).mean() > 0.9


@pytest.mark.parametrize("size", [(8, 8), (9, 31), (64, 17)])
def test_sizes(size):
    found = dead_leaves(*size, seed=0)
    width, height = size
    assert found.image.shape == (height, width, 3) and found.image.dtype == np.float32
    assert found.labels.shape == found.depth.shape == (height, width)
    assert np.isfinite(found.image).all() and found.image.min() >= 0


@pytest.mark.parametrize("size", [(7, 100), (100, 7), (40_000, 40_000)])
def test_impossible_sizes(size):
    with pytest.raises(RequestError, match="expected at least 8x8"):
        dead_leaves(*size, seed=0)


def test_leaves_in_front_are_nearer(leaves):
    assert leaves.depth.min() >= NEAR and leaves.depth.max() <= FAR
    order = np.argsort(leaves.labels.ravel())
    labels, depth = leaves.labels.ravel()[order], leaves.depth.ravel()[order]
    assert (np.diff(depth.astype(float))[np.diff(labels) > 0] < 0).all()
    assert (np.diff(depth)[np.diff(labels) == 0] == 0).all()


def test_the_spectrum_falls_like_that_of_photographs():
    """Power falls with about the second power of frequency, and edges make long tails."""
    slopes, kurtoses = [], []
    for seed in range(4):
        image = dead_leaves(256, 256, seed).image
        luma = np.log(np.maximum(image @ (0.2126, 0.7152, 0.0722), 1e-3))
        window = np.hanning(256)[:, None] * np.hanning(256)
        power = np.abs(np.fft.fft2((luma - luma.mean()) * window)) ** 2
        f = np.hypot(np.fft.fftfreq(256), np.fft.fftfreq(256)[:, None])
        at = [power[(f >= low) & (f < 2 * low)].mean() for low in (0.02, 0.04, 0.08, 0.16)]
        slopes.append(np.polyfit(range(4), np.log2(at), 1)[0])
        steps = np.diff(luma, axis=1)
        kurtoses.append(((steps - steps.mean()) ** 4).mean() / steps.var() ** 2)
    assert -2.5 < np.mean(slopes) < -1.6
    assert np.mean(kurtoses) > 6  # 3 is Gaussian


def test_sizes_of_leaves_follow_a_power_law():
    """Each octave of radii has about the same area."""
    sides = []
    for seed in range(4):
        labels = dead_leaves(512, 512, seed).labels
        sides += np.sqrt(np.unique(labels, return_counts=True)[1]).tolist()
    areas = np.square(sides)
    shares = [areas[(np.array(sides) >= s) & (np.array(sides) < 2 * s)].sum() for s in (4, 8, 16)]
    assert max(shares) < 3 * min(shares)
    assert max(sides) > 100


def test_a_palette_gives_the_colours():
    palette = np.float32([[0.4, 0.1, 0.1], [0.05, 0.2, 0.5]])
    found = dead_leaves(96, 96, 0, palette=palette)
    shares = found.image / found.image.sum(-1, keepdims=True)
    distances = [np.abs(shares - c / c.sum()).max(-1) for c in palette]
    inside = np.minimum(*distances) < 1e-3
    assert inside.mean() > 0.5  # the others are at edges
    assert all((distance < 1e-3).mean() > 0.1 for distance in distances)


def test_a_dataset_of_leaves(clpipe):
    command = ("dataset", "leaves", "-o", "set", "--resolution", "48x40", "--iso", "800", *NUMPY)
    result = clpipe(*command, "--views", 2, "--seed", 5)
    assert "made leaves_00001  2 of 2" in result.stderr and "2 of 2 images done" in result.stderr
    with OpenEXR.File("set/renders/leaves_00001.exr", separate_channels=True) as file:
        channels = {name: each.pixels for name, each in file.channels().items()}
    expected = dead_leaves(48, 40, 5, index=1)
    assert np.array_equal(channels["G"], expected.image[..., 1])
    assert np.array_equal(channels["Depth.Z"], expected.depth)
    assert np.array_equal(channels["IndexOB.X"], expected.labels)
    names = {Path(name).name for name in written(Path("set"))}
    assert {"leaves_00000.jpg", "leaves_00000.truth_clean.jpg", "leaves_00000.Depth.png"} <= names
    before = Path("set/renders/leaves_00000.exr").stat().st_mtime_ns
    stderr = clpipe(*command, "--views", 3, "--seed", 5).stderr
    assert "made leaves_00002  3 of 3" in stderr and "made leaves_00000" not in stderr
    assert Path("set/renders/leaves_00000.exr").stat().st_mtime_ns == before
    samples = package.Dataset("set/renders", iso=3200, patch=16, device="numpy", cache=0)
    assert samples[0]["image"].shape == (16, 16, 3)


def test_wrong_requests_for_leaves(clpipe, write_exr):
    command = ("dataset", "leaves", "-o", "set", *NUMPY)
    clpipe(*command, "--views", 1, "--resolution", "16x16", "--iso", 800)
    assert "has a dataset with leaves [16, 16]" in clpipe(*command, "--iso", 800, status=2).stderr
    stderr = clpipe(*command[:3], "o", *NUMPY, "--path", "arc", status=2).stderr
    assert "--path: this option applies only to a .blend, not to dead leaves" in stderr
    write_exr("in/a.exr", np.ones((8, 8, 3), np.float32))
    stderr = clpipe("dataset", "in", "-o", "p", "--palette", "in/a.exr", status=2).stderr
    assert "--palette: this option applies only to a .blend or dead leaves" in stderr
    write_exr("leaves/a.exr", np.ones((8, 8, 3), np.float32))
    stderr = clpipe(*command[:3], "q", *NUMPY, status=2).stderr
    assert "a file or directory here has the same name. Name it ./leaves" in stderr
    clpipe("dataset", "./leaves", "-o", "q", *NUMPY, "--iso", 800)


def test_the_palette_of_an_image(clpipe, write_exr):
    write_exr("red.exr", np.float32([[[0.5, 0.1, 0.1], [0, 0, 0]]] * 2))
    command = ("dataset", "leaves", "-o", "set", "--views", 1, "--resolution", "24x24", *NUMPY)
    clpipe(*command, "--iso", 800, "--palette", "red.exr")
    with OpenEXR.File("set/renders/leaves_00000.exr", separate_channels=True) as file:
        red, green = (file.channels()[name].pixels for name in "RG")
    assert np.allclose(red, 5 * green, rtol=2e-3)
