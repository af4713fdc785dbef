"""Develop thousands of small images in one process, and print its resources after every 1,000.

Images have many sizes, and are half or float, renders or mosaics. Some are damaged, too large or
processed in tiles. Outputs are JPEG, EXR and DNG. ``clpipe run`` develops half of the images, and
one ``clpipe.Pipeline`` the other half.

Memory, file descriptors, threads and OpenCL objects must not grow. The exit status is 1 if the
process has clearly more of them at the end than after the first half.
"""

import argparse
import contextlib
import gc
import os
import shutil
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

import clpipe
from clpipe.commands.main import main as command
from clpipe.images.write import write_exr

BATCH = 1000  # images per line of the table
SIZES = ((8, 8), (17, 40), (64, 64), (90, 31), (1, 9), (33, 120))  # height, width
COUNTED = ("Context", "CommandQueue", "Program", "Kernel", "Buffer")
RUNS: dict[str, list[str]] = {
    "jpg": [],
    "exr": ["--format", "exr", "--keep", "mosaic", "--iso", "3200"],
    "dng": ["--format", "dng", "--format", "png"],
    "kept": ["--start-at", "inverse_white_balance"],
    "tiles": ["--memory", "100K", "--frames", "2"],
}
alive: Counter[str] = Counter()


def count_objects() -> None:
    """Make pyopencl's objects count themselves, from creation to destruction."""
    for name in COUNTED:
        base = getattr(cl, name)

        def begin(
            self: Any, *arguments: Any, base: Any = base, name: str = name, **more: Any
        ) -> None:
            alive[name] += 1
            base.__init__(self, *arguments, **more)

        def end(self: Any, name: str = name) -> None:
            alive[name] -= 1

        setattr(cl, name, type(name, (base,), {"__init__": begin, "__del__": end}))


def write_sources(folder: Path) -> None:
    """Write two folders of links to a few files: renders, and mosaics for --start-at."""
    random = np.random.default_rng(0)
    for name, channels in (("renders", "RGB"), ("mosaics", "Y")):
        files = folder / f"{name} files"
        files.mkdir()
        (folder / name).mkdir()
        for i, size in enumerate(SIZES):
            for half in (True, False):
                pixels = random.random((*size, len(channels))).astype(np.float32)
                write_exr(files / f"{i}{'hf'[half]}.exr", pixels, channels, {}, half)
        whole = (files / "2h.exr").read_bytes()
        (files / "damaged.exr").write_bytes(whole[: len(whole) // 2])
        (files / "none.exr").write_bytes(b"no picture")
        large = np.zeros((200, 200, len(channels)), np.float32)
        write_exr(files / "too_large.exr", large, channels, {}, half=True)
        targets = sorted(files.iterdir())
        for i in range(BATCH):
            (folder / name / f"{i:04}.exr").symlink_to(targets[i % len(targets)])


def run(folder: Path, name: str, options: list[str]) -> None:
    """Develop a thousand images with ``clpipe run``."""
    inputs = folder / ("mosaics" if name == "kept" else "renders")
    arguments = ["run", str(inputs), "-o", str(folder / "out"), "--max-pixels", "30000", *options]
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stderr(nowhere):
        try:
            command([*arguments, "--quiet"], prog_name="clpipe")
        except SystemExit as end:
            status = end.code
    log = (folder / "out" / "run.jsonl").read_text("utf-8")
    failed = log.count('"status": "failed"')
    if status != 1 or not 0 < failed < BATCH // 2:
        sys.exit(f"leaks: {name}: exit status {status}, {failed} images failed")
    shutil.rmtree(folder / "out")


def process(pipeline: clpipe.Pipeline, number: int) -> None:
    """Develop a thousand images with a Pipeline."""
    random = np.random.default_rng(number)
    for i in range(BATCH):
        image = random.random((*SIZES[i % len(SIZES)], 3)).astype((np.float16, np.float32)[i % 2])
        if i % 50 == 0:
            with contextlib.suppress(clpipe.ClpipeError):
                pipeline.process(image[..., 0], "wrong")
        pipeline.process(image, str(i), **({"iso": 100 + i} if i % 3 == 0 else {}))


def resources() -> dict[str, int]:
    """Return the memory of this process in KiB, and the numbers of its objects."""
    gc.collect()
    status = Path("/proc/self/status").read_text("utf-8")
    return {
        "rss_kib": int(status.partition("VmRSS:")[2].split()[0]),
        "fds": len(os.listdir("/proc/self/fd")),
        "threads": int(status.partition("Threads:")[2].split()[0]),
        "python_threads": threading.active_count(),
        **{name: alive[name] for name in COUNTED},
        "objects": len(gc.get_objects()),
    }


def main() -> int:
    """Develop the images, and print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--images", type=int, default=20_000, metavar="N")
    options = parser.parse_args()
    count_objects()
    rows: list[dict[str, int]] = []
    with tempfile.TemporaryDirectory(prefix="clpipe-leaks-") as name:
        folder = Path(name)
        write_sources(folder)
        pipeline = clpipe.Pipeline(iso=1600)
        kinds = list(RUNS)
        for number in range(options.images // BATCH):
            kind = kinds[number // 2 % len(kinds)] if number % 2 == 0 else "Pipeline"
            if kind == "Pipeline":
                process(pipeline, number)
            else:
                run(folder, kind, RUNS[kind])
            rows.append(resources())
            if number == 0:
                print("images  what     ", "  ".join(rows[0]))
            cells = (str(n).rjust(len(k)) for k, n in rows[-1].items())
            print(f"{(number + 1) * BATCH:6}  {kind:9}", "  ".join(cells), flush=True)
    half = rows[len(rows) // 2 - 1]  # after every kind of run
    grown = [k for k, n in rows[-1].items() if n > half[k] * 1.05 + 2]
    print(f"grown since the middle: {', '.join(grown) or 'nothing'}")
    return 1 if grown else 0


if __name__ == "__main__":
    sys.exit(main())
