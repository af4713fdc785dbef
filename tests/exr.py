"""An EXR writer for tests, which can also write invalid sizes."""

import struct

import numpy as np


def exr(channels, width, height, display=None, attributes=()):
    """Return an EXR of half channels, {name: (plane, sampling)}, with a claimed size."""

    def attribute(name, kind, data):
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data

    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iB3xii", 1, 0, step, step)
        for name, (_, step) in sorted(channels.items())
    )
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    wide, high = display or (width, height)
    out = struct.pack("<ii", 20000630, 2)
    out += attribute("channels", "chlist", listed + b"\0") + attribute(
        "compression", "compression", b"\0"
    )
    out += attribute("dataWindow", "box2i", box)
    out += attribute("displayWindow", "box2i", struct.pack("<4i", 0, 0, wide - 1, high - 1))
    out += attribute("lineOrder", "lineOrder", b"\0")
    out += attribute("pixelAspectRatio", "float", struct.pack("<f", 1))
    out += attribute("screenWindowCenter", "v2f", bytes(8))
    out += attribute("screenWindowWidth", "float", struct.pack("<f", 1))
    out += b"".join(attribute(*a) for a in attributes) + b"\0"
    rows = []
    for y in range(min(height, 1000)):
        data = b"".join(
            np.asarray(plane[y // step], np.float16).tobytes()
            for _, (plane, step) in sorted(channels.items())
            if y % step == 0
        )
        rows.append(struct.pack("<ii", y, len(data)) + data)
    place = len(out) + 8 * len(rows)
    offsets = np.cumsum([place, *map(len, rows)])[:-1].astype("<u8")
    return out + offsets.tobytes() + b"".join(rows)
