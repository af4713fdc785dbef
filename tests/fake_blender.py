"""What an installed Blender would do with the script of clpipe.scenes: it says and writes the same.

A scene is a text here: "refuse: MESSAGE", "die after N", or anything else, which renders.
"""

import json
import os
import sys
import time

import numpy as np
import OpenEXR

MARK = "@clpipe "


def send_event(event, **values):
    print(MARK + json.dumps({"event": event, **values}), flush=True)


def names(views):
    if "frames" in views:
        return [f"frame_{frame:04d}" for frame in views["frames"]]
    if "cameras" in views:
        return [each["name"] for each in views["cameras"]]
    return [f"view_{number:03d}" for number in range(views["count"])]


def camera(name, width, height):
    matrix = float(name[-3:])
    return {
        **{"file": f"{name}.exr", "width": width, "height": height},
        "K": [[40.0, 0.0, width / 2], [0.0, 40.0, height / 2], [0.0, 0.0, 1.0]],
        **{"R": np.eye(3).tolist(), "t": [matrix, 0.0, 2.0]},
    }


def render(path, name, width, height):
    random = np.random.default_rng(int(name[-3:]))
    channels = {
        "RGB": random.random((height, width, 3)).astype(np.float16),
        "Depth.Z": np.full((height, width), 5, np.float32),
        "Normal.X": np.zeros((height, width), np.float32),
        "Normal.Y": np.zeros((height, width), np.float32),
        "Normal.Z": np.ones((height, width), np.float32),
        "IndexOB.X": np.arange(height * width, dtype=np.float32).reshape(height, width) % 3,
        **{f"Vector.{c}": np.zeros((height, width), np.float32) for c in "XYZW"},
    }
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(f"{path}.part")
    os.replace(f"{path}.part", path)


def main():
    with open(sys.argv[-1], encoding="utf-8") as file:
        request = json.load(file)
    with open(request["scene"], encoding="utf-8") as file:
        scene = file.read().strip()
    print("Blender 4.9.9 (fake)")
    if scene.startswith("refuse: "):
        send_event("refused", message=scene.removeprefix("refuse: "))
        sys.exit(1)
    width, height = request["resolution"] or (24, 16)
    cameras = [camera(name, width, height) for name in names(request["views"])]
    objects = {"1": ["floor"], "2": ["ball", "ball.001"]}
    layers = ["Depth", "Normal", "IndexOB"]
    notes = ["3 of 9 places see too little"] if scene == "a maze" else []
    said = {"objects": objects, "layers": layers, "unit_metres": 0.1, "notes": notes}
    send_event("scene", blender="4.9.9", views=cameras, **said)
    for number, each in enumerate(cameras):
        if scene == f"die after {number}":
            print("Segmentation fault (not really)")
            sys.exit(11)
        path = os.path.join(request["folder"], each["file"])
        start = time.perf_counter()
        if is_new := not os.path.exists(path):
            render(path, each["file"].removesuffix(".exr"), width, height)
        seconds = (time.perf_counter() - start) if is_new else 0.0
        send_event("rendered", name=each["file"].removesuffix(".exr"), seconds=seconds)


if __name__ == "__main__":
    main()
