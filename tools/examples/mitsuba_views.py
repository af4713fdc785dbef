"""Render views of a small scene with Mitsuba 3: half EXR with depth and normals, and cameras.

    pip install mitsuba numpy
    python tools/examples/mitsuba_views.py renders --views 8
    clpipe dataset renders -o set --iso 100,3200

The views are on an arc. Depth is along the optical axis, as clpipe and COLMAP expect it. Mitsuba's
own depth is along each ray.
"""

import argparse
import json
from pathlib import Path

import numpy as np

WARM_AND_COLD = ([6, 4.5, 3], [1, 1.2, 1.5])
FOV = 40.0  # degrees, across


def surface(kind, place, colour, **more):
    """Return a shape with a matte surface; `colour` is a number or the name of a texture plugin."""
    texture = {"type": "rgb", "value": colour}
    if isinstance(colour, str):
        texture = {"type": colour, "to_uv": T().scale(8)}
    return {
        "type": kind,
        "to_world": place,
        "bsdf": {"type": "diffuse", "reflectance": texture},
        **more,
    }


def scene():
    """Return a scene: a checked floor, a white wall, a box, a glass ball and two lamps."""
    upright = T().rotate([1, 0, 0], 90)
    glass = {"type": "dielectric"}
    ball = {"type": "sphere", "center": [-0.7, 0, 0.5], "radius": 0.5, "bsdf": glass}
    warm, cold = ({"type": "area", "radiance": {"type": "rgb", "value": v}} for v in WARM_AND_COLD)
    return {
        "type": "scene",
        "integrator": {
            "type": "aov",
            "aovs": "place:position,normal:sh_normal",
            "image": {"type": "path", "max_depth": 12},
        },
        "floor": surface("rectangle", T().scale(3), "checkerboard"),
        "wall": surface("rectangle", T().translate([0, 2, 1]) @ upright @ T().scale(3), 0.8),
        "box": surface("cube", T().translate([0.8, 0.2, 0.35]) @ T().scale(0.35), "checkerboard"),
        "ball": ball,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.4, 0.45, 0.5]}},
        "warm": surface("sphere", T().translate([2, -2, 3]) @ T().scale(0.8), 0.0, emitter=warm),
        "cold": surface("sphere", T().translate([-2, -3, 3]) @ T().scale(1), 0.0, emitter=cold),
    }


def camera(angle, size, samples):
    """Return a sensor that looks at the middle from an angle in degrees."""
    place = T().rotate([0, 0, 1], angle) @ mi.ScalarPoint3f(0, -4.5, 1.6)
    film = {
        **{"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgb"},
        "rfilter": {"type": "box"},
    }
    view = T().look_at(origin=place, target=[0, 0, 0.5], up=[0, 0, 1])
    sampler = {"type": "independent", "sample_count": samples}
    return {"type": "perspective", "fov": FOV, "to_world": view, "film": film, "sampler": sampler}


def pinhole(name, sensor, size):
    """Return a view of cameras.json, x = K (R X + t) by OpenCV; Mitsuba reverses x and y."""
    focal = size[0] / 2 / np.tan(np.deg2rad(FOV / 2))
    place = np.array(sensor["to_world"].matrix, float)
    rotation = np.diag([-1.0, -1.0, 1.0]) @ place[:3, :3].T
    return {
        "file": name,
        "K": [[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]],
        "R": rotation.tolist(),
        "t": (-rotation @ place[:3, 3]).tolist(),
    }


def main(folder, count, size, samples):
    """Render the views into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    world, views = mi.load_dict(scene()), []
    for number, angle in enumerate(np.linspace(-25, 25, count)):
        sensor, name = camera(float(angle), size, samples), f"view_{number:03d}.exr"
        views.append(pinhole(name, sensor, size))
        pixels = np.array(mi.render(world, sensor=mi.load_dict(sensor), seed=number))
        colour, places, normals = pixels[..., :3], pixels[..., 3:6], pixels[..., 6:9]
        depth = places @ np.array(views[-1]["R"])[2] + views[-1]["t"][2]
        depth[np.abs(normals).sum(-1) == 0] = np.inf  # no surface
        layers = np.concatenate([colour, depth[..., None], normals], -1, dtype=np.float32)
        channels = ["R", "G", "B", "Depth.Z", "Normal.X", "Normal.Y", "Normal.Z"]
        bitmap = mi.Bitmap(layers, mi.Bitmap.PixelFormat.MultiChannel, channels)
        bitmap.write(str(folder / name))
    cameras = {"width": size[0], "height": size[1], "views": views}
    (folder / "cameras.json").write_text(json.dumps(cameras, indent=1), encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Render views of a small scene with Mitsuba 3.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 320), metavar=("W", "H"))
    parser.add_argument("--samples", type=int, default=128)
    options = parser.parse_args()

    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    T = mi.ScalarTransform4f
    main(options.folder, options.views, options.size, options.samples)
