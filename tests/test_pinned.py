"""What came out of a render once comes out of it ever after: digests of raws, pictures, truths.

That device and NumPy agree is held elsewhere; here one commit agrees with the one before. Who means
to change a picture renews the digests and says so: ``python tests/test_pinned.py``.
"""

import hashlib
import json
import shlex
import sys
import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import rawpy
from click.testing import CliRunner

from clpipe.commands.main import main
from clpipe.engine.cpu_target import equivalent_target
from clpipe.engine.device import Device

PINNED = Path(__file__).with_name("pinned.json")

# Options behind "clpipe run render.exr".
RUNS = {
    "default": "--format dng --format npy --truth mosaic --truth variance --keep quantize",
    "pictures": "--format png --frames 2 --bracket -1,1 --truth clean --truth development"
    " --truth iid",
    "paper": "-c paper --format png --iso 3200",
    "syb3r": "-c syb3r --format png",
    "nikon": "-c nikon-d800-jpeg --format png --iso 1600",
    "lens": "--format png --carry Depth --set distortion.method=brown_conrady"
    " --set distortion.k1=-0.1 --set distortion.fx=70 --set vignetting.method=pa"
    " --set vignetting.k1=-0.3 --set defocus.method=thin_lens --set defocus.f_number=2"
    " --set defocus.focus_distance=2 --set defocus.sensor_width=74.68711",
    "draws": "--format png --camera sony-a7r2 --iso 800 --set 'exposure.ev={uniform=[-1, 1]}'"
    " --set 'sensor_noise.a={log_uniform=[1e-4, 0.01]}' --seed 7",
    "patches": "--format npy --patch 24 --patches-per-image 3 --augment --truth mosaic",
    "methods": "--format png --set demosaic.method=menon2007 --set denoise.method=non_local_means"
    " --set white_balance.method=gray_world --set tone_curve.method=neutral",
}


def render(folder: Path) -> None:
    """A render of 73 by 41 px of numbers that every machine writes in the same way."""
    y, x = np.mgrid[:41, :73].astype(np.int64)
    steps = [(x * a + y * b + (x // 9) * (y // 7) * c) % 97 / 128 for a, b, c in
             ((1, 2, 5), (2, 1, 11), (3, 5, 7))]  # fmt: skip
    depth = 1 + (x // 16) / 2 + y / 64
    pixels = np.stack([*steps, depth], axis=-1).astype(np.float32)
    spec = oiio.ImageSpec(73, 41, 4, oiio.FLOAT)
    spec.channelnames = ("R", "G", "B", "Depth.Z")
    spec.attribute("DateTime", "2026:01:01 00:00:00")
    file = oiio.ImageOutput.create(str(folder / "render.exr"))
    assert file.open(str(folder / "render.exr"), spec)
    assert file.write_image(pixels)
    assert file.close()


def digest(path: Path) -> str:
    """Return a digest of an image's samples, independent of the library's compression."""
    if path.suffix == ".npy":
        values = np.load(path)
    elif path.suffix == ".dng":
        with rawpy.imread(str(path)) as raw:
            values = raw.raw_image.copy()
    else:
        values = oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT)
    text = f"{values.dtype.str} {values.shape}".encode()
    return hashlib.sha256(text + np.ascontiguousarray(values).tobytes()).hexdigest()[:16]


def digests(options: str, folder: Path) -> dict[str, str]:
    render(folder)
    out = folder / "out"
    arguments = [
        "run",
        str(folder / "render.exr"),
        "-o",
        str(out),
        "--quiet",
        *shlex.split(options),
    ]
    result = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    found = {p.relative_to(out).as_posix(): p for p in sorted(out.rglob("*"))}
    return {
        name: digest(path)
        for name, path in found.items()
        if path.suffix in (".png", ".npy", ".exr", ".dng")
    }


# Their kernels take longest to compile, and are compared with NumPy in any case.
SLOW = {"methods", "syb3r"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in RUNS]
)
def test_a_run_makes_what_it_has_always_made(name: str, device: Device, tmp_path: Path) -> None:
    made = digests(RUNS[name], tmp_path)
    pinned = json.loads(PINNED.read_text())[name]
    assert made.keys() == pinned.keys()
    if equivalent_target(device.info.target.name) not in ("skx", "haswell"):
        # Pictures are pinned for CPUs that multiply and add in one instruction; raws for all.
        made, pinned = ({n: d for n, d in each.items() if is_raw(n)} for each in (made, pinned))
    assert made == pinned


def is_raw(name: str) -> bool:
    return name.endswith(".dng") or "quantize" in name or "mosaic" in name


if __name__ == "__main__":
    values = {}
    for name, options in RUNS.items():
        with tempfile.TemporaryDirectory() as folder:
            values[name] = digests(options, Path(folder))
    (Path(sys.argv[1]) if sys.argv[1:] else PINNED).write_text(json.dumps(values, indent=1) + "\n")
