"""Layers are interpolated within a surface only, without a shift; unknown pixels are invalid."""

import numpy as np
import pytest

import clpipe
from clpipe.reference.carried import Layer, warp
from clpipe.reference.geometry import Scaling
from clpipe.reference.lens import DistortionMap
from clpipe.reference.radial import Radial
from clpipe.reference.resample import Resampling, overlap
from clpipe.reference.surfaces import DEPTH, cells

WIDTH, HEIGHT = 120, 81


def scaled(scale):
    return Scaling(tuple(Resampling(axis, scale, overlap, 0.5) for axis in ("rows", "columns")))


GEOMETRIES = {
    "half": scaled(0.5),
    "some": scaled(0.37),
    "lens": DistortionMap(Radial.of(1.0, 0.0, -0.08), focal=(90.0, 90.0)),
}


def room(x, y):
    """Return a floor, a wall and a pillar in front of them: depth, normals, label."""
    u, v = (x - WIDTH / 2) / 90, (y - HEIGHT / 2) / 90
    with np.errstate(divide="ignore"):
        floor = np.where(v > 0, 1.5 / v, np.inf)
    wall = 10 / (1 + 0.2 * u)
    pillar = (x > 30.0) & (x < 47.5)
    depth = np.where(pillar, 2.0, np.minimum(floor, wall))
    label = np.where(pillar, 3, np.where(floor < wall, 1, 2))
    normals = np.array([[0, 0, 0], [0, -1, 0], [-0.2, 0, -1], [0, 0, -1]])
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1)[:, None]
    return depth, normals[label], label


def picture():
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return [each if each.ndim == 3 else each[..., None] for each in room(x, y)]


@pytest.mark.parametrize("geometry", GEOMETRIES.values(), ids=GEOMETRIES)
def test_each_layer_is_that_of_one_surface(geometry):
    depth, normals, label = picture()
    layers = [Layer("depth", depth), Layer("normal", normals), Layer("label", label)]
    (z, n, own), valid = warp(layers, geometry, WIDTH, HEIGHT)
    y, x = np.mgrid[: own.shape[0], : own.shape[1]] + 0.5
    at = geometry.origins(x, y, WIDTH, HEIGHT)
    true_z, true_n, true_label = room(*at)
    same = (valid == 1) & (own[..., 0] == true_label)
    assert same.sum() > 0.95 * valid.sum() > 0.8 * valid.size
    relative = abs(z[..., 0] / true_z - 1)[same]
    # On an edge, each pixel has the depth of one surface.
    assert np.median(relative) < 1e-6 and (relative < 1e-4).mean() > 0.93
    assert relative.max() < 0.05  # never between two
    assert abs(n - true_n)[same].max() < 1e-6 or (abs(n - true_n)[same] < 1e-6).mean() > 0.99
    assert set(np.unique(z[..., 0][own[..., 0] == 3]).round(6)) == {2.0}


def test_a_half_picture_has_no_shift():
    x = np.mgrid[:64, :64][1]
    for edge in range(20, 24):
        label = (x >= edge).astype(np.uint8)[..., None]
        (half,), _ = warp([Layer("label", label)], scaled(0.5), 64, 64)
        assert (1 - half[..., 0]).sum() / 32 == pytest.approx(edge / 2)
        (half,), _ = warp([Layer("label", label.swapaxes(0, 1))], scaled(0.5), 64, 64)
        assert (1 - half[..., 0]).sum() / 32 == pytest.approx(edge / 2)


def test_flow_is_of_one_surface():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    near = (abs(x - 50) < 18) & (abs(y - 40) < 21)
    flow = np.where(near[..., None], np.float32([12, -3]), np.float32([-1, 0.5]))
    vectors = (((0, 1), (1, 1)),)
    for name in ("half", "some"):
        geometry = GEOMETRIES[name]
        (moved,), _ = warp([Layer("flow", flow, vectors=vectors)], geometry, WIDTH, HEIGHT)
        columns, rows = geometry.size(WIDTH, HEIGHT)
        kinds = np.unique(
            (moved / [columns / WIDTH, rows / HEIGHT]).reshape(-1, 2).round(3), axis=0
        )
        assert kinds.tolist() == [[-1, 0.5], [12, -3]]


@pytest.mark.parametrize("bad", [np.nan, -1.0, 0.0])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_depth_that_is_none_is_not_valid(bad, scale):
    depth = np.full((8, 12), 2.0, np.float32)
    depth[2, 4] = bad
    depth[6, 6:] = np.inf  # the sky
    pipeline = clpipe.Pipeline(device="numpy", resize={"scale": scale}, stages=["resize", "gamma"])
    moved, valid = pipeline.carry(depth, "depth")
    assert np.array_equal(valid == 1, moved > 0)
    assert 1 <= (valid == 0).sum() <= 2 or scale == 0.5
    assert set(moved[valid == 1]) <= {2.0, np.inf}


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (2, 2)])
def test_tiny_layers(shape):
    assert cells(np.ones((*shape, 1)), DEPTH).shape == (shape[0] + 1, shape[1] + 1)
    (moved,), valid = warp([Layer("depth", np.ones((*shape, 1)))], scaled(0.5), *shape[::-1])
    assert (moved == 1).all() and (valid == 1).all()
