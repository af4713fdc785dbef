"""Read mutated files. Each must be read or rejected without traceback, crash or much memory.

    tools/run stress fuzz [--cases N] [--seed N] [--keep FOLDER] [FILE...]

The tool tries every reader of the package that fits a file's extension. Without FILE, it makes
small files of each kind. Cases run in a separate process, which restarts after a crash or a hang.
The tool prints each failure, and --keep stores its file. The exit status is 1 after any failure.
"""

import argparse
import faulthandler
import json
import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

from tools.shared.options import parser_of

CPU_SECONDS = 5.0  # for one case
SECONDS = 60.0  # elapsed time for one case, which may wait for other processes
MEMORY = 3 * 2**30  # bytes of address space; libraries take the first half of a GiB
MAX_PIXELS = 1_000_000
# On machines with many cores, threads and their heaps use much address space.
LIMITS = {"OPENBLAS_NUM_THREADS": "1", "OPENIMAGEIO_THREADS": "1", "MALLOC_ARENA_MAX": "1"}
LIMITS["PYTHONWARNINGS"] = "error"
NUMBERS = (0, 1, 2, 255, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 10**9, 0x7FC00000)
WORDS = (b"nan", b"inf", b"-1", b"1e999", b"[]", b"{}", b'""', b"true", b"=", b"[", b"\n", b"\xff")
TEXTS = (".toml", ".csv", ".cube", ".jsonl", ".json", ".c")


def mutated(data: bytes, random_: random.Random, text: bool) -> bytes:
    """Apply one to eight changes, most of them in the header at the beginning of the file."""
    out = bytearray(data)
    for _ in range(random_.choice((1, 1, 2, 3, 8))):
        reach = len(out) if text else min(len(out), random_.choice((700, 700, 5000, len(out))))
        at = random_.randrange(max(reach, 1))
        length = random_.choice((1, 1, 4, 16, 200))
        kind = random_.randrange(7)
        if kind == 0 and out:
            out[min(at, len(out) - 1)] ^= 1 << random_.randrange(8)
        elif kind == 1:
            number = random_.choice(NUMBERS).to_bytes(4, random_.choice(("little", "big")))
            out[at : at + 4] = random_.choice(WORDS) if text else number
        elif kind == 2:
            del out[at : at + length]
        elif kind == 3:
            out[at:at] = out[at : at + length]
        elif kind == 4:
            other = random_.randrange(max(len(out), 1))
            out[at : at + length] = out[other : other + length]
        elif kind == 5:
            if random_.random() < 0.1:
                out[at:at] = out[at : at + length] * 2000
        elif random_.random() < 0.2:
            del out[at:]
    return bytes(out)


def case(number: int, seed: int, files: list[Path], folder: Path) -> Path:
    """Write the mutated file of a case, and return its path."""
    random_ = random.Random(f"{seed} {number}")
    source = random_.choice(files)
    path = folder / f"case{number}{source.suffix}"
    path.write_bytes(mutated(source.read_bytes(), random_, source.suffix in TEXTS))
    return path


@cache
def readers(suffix: str) -> tuple[Callable[[Path], object], ...]:
    """Return the readers of files with an extension."""
    from clpipe.analysis.calibration.frames import FrameOverrides, read_frame
    from clpipe.analysis.emva.series import read_series
    from clpipe.analysis.noise_models.read import import_camera
    from clpipe.analysis.pictures import load_picture
    from clpipe.batch.replay import replay_of
    from clpipe.batch.tars import Members, is_clpipe_tar
    from clpipe.camera.profile import load_camera
    from clpipe.chain.files import load_settings
    from clpipe.chain.making import make_chain
    from clpipe.chain.render_camera import RenderCamera
    from clpipe.chain.request import Request
    from clpipe.chain.settings import settings_from
    from clpipe.images.attributes import read_attributes
    from clpipe.images.passes import find_layers, read_layer
    from clpipe.inputs.find import Job
    from clpipe.inputs.loader import ImageLoader
    from clpipe.inputs.manifest import check_rows, read_manifest
    from clpipe.inputs.poses import assign_views
    from clpipe.outputs.sidecar import read_sidecar

    def loading(**options: object) -> Callable[[Path], object]:
        loader = ImageLoader(Request.from_options(max_pixels=MAX_PIXELS, **options))

        def load(path: Path) -> object:
            job = Job(path, path.name)
            loader.first_chain([job])
            return loader.enter(job, loader.read(job))

        return load

    def frame(path: Path) -> object:
        return read_frame(path, FrameOverrides()).read()

    def members(path: Path) -> object:
        tar = Members(path)
        return [tar.sidecar(name) for name in tar.locations], is_clpipe_tar(path)

    def layers(path: Path) -> object:
        return [read_layer(path, layer, MAX_PIXELS) for layer in find_layers(path)[:8]]

    def setting(stage: str, method: str, parameter: str) -> Callable[[Path], object]:
        return lambda path: settings_from({stage: {"method": method, parameter: str(path)}})

    def rows(path: Path) -> object:
        return check_rows(read_manifest(path), settings_from({}))

    def poses(path: Path) -> object:
        return assign_views([Job(Path("a.exr"), "a.exr")], path, RenderCamera())

    noise_model = partial(import_camera, camera=None, output=None)
    report = setting("picture_noise", "intensity_dependent", "measured")
    curve = setting("tone_curve", "file", "path")
    inverse_curve = setting("inverse_tone_curve", "file", "path")
    by_ending = {
        **dict.fromkeys((".dng", ".nef", ".cr2", ".kdc"), (loading(), frame, noise_model)),
        ".c": (noise_model,),
        ".raw": (loading(values={"dump": "24x16:uint16le"}),),
        ".toml": (
            lambda path: make_chain(load_settings(str(path)).drawn("key")),
            lambda path: load_camera(str(path)),
        ),
        ".csv": (rows, curve, inverse_curve),
        ".jsonl": (rows,),
        ".cube": (curve, inverse_curve),
        ".json": (
            *(partial(replay_of, inputs=(), max_pixels=None), read_sidecar, report, noise_model),
            poses,
        ),
        ".tar": (members,),
        ".txt": (read_series,),
    }
    images = (
        *(loading(), loading(transfer="srgb"), loading(config="unprocess")),
        *(loading(start_at=step) for step in ("normalize", "demosaic", "gamma")),
        *(load_picture, frame, read_attributes, layers),
    )
    return by_ending.get(suffix, images)


def attempt(path: Path) -> str:
    """Try all readers of a file; return "read" if one succeeds, otherwise "rejected"."""
    from clpipe.base.errors import ClpipeError

    outcomes = []
    for reader in readers(path.suffix.lower()):
        try:
            reader(path)
            outcomes.append("read")
        except FileNotFoundError:  # a truncated sidecar counts as missing
            outcomes.append("rejected")
        except ClpipeError as error:
            outcomes.append("rejected")
            text = str(error)
            assert text.isprintable(), repr(text)
            assert len(text) < 5000, text
            assert "bad_alloc" not in text, text
    return min(outcomes)


def series_text() -> str:
    """Return the text of a series for EMVA 1288."""
    lines = ["# a", "v 3.1", "n 12 640 480"]
    for number in range(1, 10):
        for exposure in (f"b {number} {number}0,5", f"d {number}"):
            lines += [exposure, f"i images\\{number}.png", "i b.png"]
    return "\n".join([*lines, "b 1 5", *["i a.png"] * 3, "d 1", *["i a.png"] * 3])


def make_seeds(folder: Path) -> list[Path]:
    """Write small files of every kind that clpipe reads."""
    import numpy as np
    import OpenImageIO as oiio

    from clpipe.camera.profile import built_in_cameras
    from clpipe.chain.files import built_in_configs
    from tests.exr import exr

    light = np.random.default_rng(0).random((16, 24, 3)).astype(np.float32)
    half, byte, word = oiio.HALF, oiio.UINT8, oiio.UINT16

    def write(name: str, pixels: object, type_: object, channels: str = "", **attributes: object):
        array = np.atleast_3d(pixels)
        spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], type_)
        if channels:
            spec.channelnames = tuple(channels.split(","))
        for key, value in attributes.items():
            spec.attribute(key, value)
        if name == "tiled.exr":
            spec.tile_width = spec.tile_height = 16
        file = oiio.ImageOutput.create(str(folder / name))
        assert file.open(str(folder / name), spec) and file.write_image(array) and file.close()

    for compression in ("none", "rle", "zip", "piz", "pxr24", "b44", "dwaa"):
        write(f"{compression}.exr", light, half, compression=compression)
    write("tiled.exr", light, half)
    write("layers.exr", np.tile(light, 2), oiio.FLOAT, "R,G,B,depth.R,depth.G,depth.B")
    write("mosaic.exr", light[..., 0], half, "Y")
    for name in ("a.hdr", "a.pfm", "a.tif"):
        write(name, light, oiio.FLOAT)
    for name in ("a.png", "8.tif", "a.jpg"):
        write(name, light, byte)
    for name in ("16.png", "16.tif"):
        write(name, light, word)
    write("mosaic.tif", light[..., 0], word)
    write("progressive.jpg", light, byte, **{"jpeg:progressive": 1})
    quarter = light[::2, ::2, 0] - 0.5
    chroma = {"Y": (light[..., 0], 1), "RY": (quarter, 2), "BY": (quarter, 2)}
    primaries = struct.pack("<8f", 0.7347, 0.2653, 0, 1, 0.0001, -0.077, 0.32168, 0.33767)
    attributes = [("chromaticities", "chromaticities", primaries)]
    (folder / "chroma.exr").write_bytes(exr(chroma, 24, 16, attributes=attributes))
    (folder / "a.raw").write_bytes((light[..., 0] * 4095).astype("<u2").tobytes())
    made = ("--device", "numpy", "--keep", "all", "--format", "png", "--format", "dng")
    for more in (made, ("--device", "numpy", "--webdataset", "1")):
        command = [sys.executable, "-m", "clpipe", "run", folder / "zip.exr", "-o", folder, *more]
        subprocess.run(command, check=True, capture_output=True)
    noise = {"sigma": 0.01, "intensity": {"mean": [0.1, 0.5], "sigma": [0.01, 0.02]}}
    report = {"kind": "display", "channels": dict.fromkeys(("R", "G", "B"), noise)}
    profile = {"iso": 800, "a": [1e-5, 1e-5, 1e-5], "b": [0, 0, 0], "skip": False}
    models = [{"model": "A", "profiles": [profile, {**profile, "iso": 1600}]}]
    rows = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    view = {"file": "a.exr", "K": [[9, 0, 2], [0, 9, 1.5], [0, 0, 1]], "R": rows, "t": [0, 0, 1]}
    view |= {"model": "PINHOLE", "distortion": {"k1": 0}}
    frame = {"file_path": "./a", "transform_matrix": [*([*row, 2] for row in rows), [0, 0, 0, 1]]}
    coefficients = "".join(
        f"noise_model_{key}[] = {{ 1e-6, 2e-6, 3e-6, 4e-6 }};\n" for key in "ABCD"
    )
    texts = {
        "noiseprofiles.json": json.dumps({"noiseprofiles": [{"maker": "M", "models": models}]}),
        "model.c": f"for (int sens = 100; sens <= 6400; sens += 100)\n{coefficients}sens / 800.0",
        "report.json": json.dumps(report),
        "cameras.json": json.dumps({"width": 4, "height": 3, "views": [view]}),
        "transforms.json": json.dumps({"camera_angle_x": 0.9, "frames": [frame]}),
        "curve.csv": "x,y\n0,0\n0.25,0.4\n1,1\n",
        "curve.cube": 'TITLE "a"\nLUT_1D_SIZE 3\nDOMAIN_MIN 0 0 0\n0 0 0\n0.5 0.5 0.5\n1 1 1\n',
        "list.csv": "path,name,iso,frames,sensor_noise.a,demosaic.method\n"
        'a.exr,b/c,800,,1e-4,bilinear\n"d, e.exr",,"{choice = [100, 400]}",3,,\n',
        "list.jsonl": '{"path": "a.exr", "iso": 800, "sensor_noise": {"a": 1e-4, "b": null}}\n'
        '{"path": "b.exr", "name": "c", "frames": 2, "exposure.ev": {"uniform": [-1, 1]}}\n',
        "EMVA1288_Data.txt": series_text(),
        "draws.toml": 'seed = 3\niso = { log_uniform = [200, 6400] }\nskip = ["denoise"]\n'
        "[exposure]\nev = { normal = [0, 0.5] }\n[output]\njpeg_quality = 90\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text, "utf-8")
    for path in (*list(built_in_cameras().values())[::9], *built_in_configs().values()):
        shutil.copy(path, folder)
    (folder / "run.jsonl").unlink()
    return sorted(path for path in folder.iterdir() if path.is_file())


def work(numbers: range, seed: int, files: list[Path], folder: Path) -> None:
    """Run cases, and write the result of each to a file. Signals end a process that hangs."""
    faulthandler.enable()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    with (folder / "progress").open("w", buffering=1, encoding="utf-8") as progress:
        for number in numbers:
            path = case(number, seed, files, folder)
            signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
            signal.setitimer(signal.ITIMER_REAL, SECONDS)
            try:
                result = attempt(path)
            except Exception:
                result = "traceback"
                print(f"case {number}", file=sys.stderr)
                traceback.print_exc()
            progress.write(f"{result}\n")
            path.unlink()


def main() -> int:
    """Run the cases, and count their results."""
    parser = parser_of(__doc__)
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="files to mutate")
    parser.add_argument("--cases", type=int, default=2000, help="mutated files [%(default)s]")
    parser.add_argument("--seed", type=int, default=0, help="of the mutations [%(default)s]")
    parser.add_argument("--keep", type=Path, help="a folder for files that cause failures")
    parser.add_argument("--from", dest="first", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.first is not None:
        work(range(options.first, options.cases), options.seed, options.files, options.folder)
        return 0
    counts: Counter[str] = Counter()
    bad: list[tuple[int, str]] = []
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as seeds:
        options.files = options.files or make_seeds(Path(seeds))
        folder, number = Path(name), 0
        while number < options.cases:
            number, ended = supervise(options, folder, number, counts)
            bad += ended
        for which, how in bad:
            path = case(which, options.seed, options.files, folder)
            print(f"case {which}{path.suffix}: {how}")
            if options.keep:
                options.keep.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, options.keep)
    print(", ".join(f"{count} {how}" for how, count in sorted(counts.items())))
    return 1 if bad else 0


def supervise(
    options: argparse.Namespace, folder: Path, first: int, counts: Counter[str]
) -> tuple[int, list[tuple[int, str]]]:
    """Run cases in a process until it ends; return the next case and the failures."""
    progress = folder / "progress"
    progress.write_text("", "utf-8")
    arguments = [f"--cases={options.cases}", f"--seed={options.seed}", f"--from={first}"]
    command = [sys.executable, "-m", "tools.stress.fuzz", *arguments, f"--folder={folder}"]
    command += map(str, options.files)
    environment = os.environ | LIMITS
    done = subprocess.run(command, stdout=subprocess.DEVNULL, env=environment, check=False)
    ended = progress.read_text("utf-8").split()
    counts.update(ended)
    failed = [(first + n, how) for n, how in enumerate(ended) if how == "traceback"]
    number = first + len(ended)
    if done.returncode == 0:
        return number, failed
    is_hang = -done.returncode in (signal.SIGPROF, signal.SIGALRM)
    how = "hang" if is_hang else "crash"
    counts[how] += 1
    status = "" if is_hang else f", status {done.returncode}"
    return number + 1, [*failed, (number, how + status)]


if __name__ == "__main__":
    sys.exit(main())
