"""Measure training patches per second through ``clpipe.Dataset``, with workers like PyTorch's.

Each sample has a noisy and a clean raw and a noisy and a clean picture, with a random camera and
ISO. The tool first writes synthetic renders. Without options, it prints a line of
docs/performance.md.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

import clpipe
from clpipe.images.write import write_exr

CAMERAS = ["sony-a7r2", "canon-5d2", "canon-6d", "nikon-d850"]
BATCH = 32


def write_renders(folder: Path, count: int, side: int) -> None:
    """Write half EXRs of smooth colours with a fine texture."""
    y, x = np.mgrid[0:side, 0:side] / side
    for i in range(count):
        texture = np.random.default_rng(i).random((side, side, 3)) * 0.1
        waves = [0.25 + 0.2 * np.sin(6 * (i + 1) * (x * c + y)) for c in (1, 0.5, 0.2)]
        pixels = (np.stack(waves, -1) + texture).astype(np.float32)
        write_exr(folder / f"{i}.exr", pixels, "RGB", {}, half=True)


def dataset(folder: Path, patch: int, epochs: int) -> clpipe.Dataset:
    """Return the dataset to time."""
    return clpipe.Dataset(
        folder,
        patch=patch,
        raw="packed",
        camera={"choice": CAMERAS},
        iso={"log_uniform": [200, 3200]},
        epochs=epochs,
    )


def work(samples: clpipe.Dataset, number: int, workers: int, ready, begin, done) -> None:
    """Load every ``workers``-th batch from ``number`` on, like a worker of a DataLoader."""
    start = time.perf_counter()
    samples[0]
    first = time.perf_counter() - start
    samples.__getitems__(range(BATCH))  # may compile more kernels
    ready.put(first)
    begin.wait()
    cpu = time.process_time()
    for i in range(number * BATCH, len(samples), workers * BATCH):
        samples.__getitems__(range(i, min(i + BATCH, len(samples))))
        if i < len(samples) // 4:
            early = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    late = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    done.put((time.process_time() - cpu, early / 1024, late / 1024))


def main() -> None:
    """Time the patches, and print a row of the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--patches", type=int, default=10_000, help="approximate number of patches")
    parser.add_argument("--patch", type=int, default=128, help="the sides of a patch, in px")
    parser.add_argument("--side", type=int, default=512, help="the sides of a render, in px")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        write_renders(Path(folder), 24, options.side)
        samples = dataset(Path(folder), options.patch, max(options.patches // 384, 1))
        ready, done, begin = spawn.Queue(), spawn.Queue(), spawn.Event()
        processes = [
            spawn.Process(target=work, args=(samples, i, options.workers, ready, begin, done))
            for i in range(options.workers)
        ]
        for process in processes:
            process.start()
        first = max(ready.get() for _ in processes)
        start = time.perf_counter()
        begin.set()
        cpu, early, late = zip(*(done.get() for _ in processes), strict=True)
        seconds = time.perf_counter() - start
        for process in processes:
            process.join()
    each = sum(cpu) / len(samples) * 1e3
    print(
        f"| {options.patch}x{options.patch} of {options.side}x{options.side} "
        f"| {len(samples) / seconds:.0f} | {each:.1f} ms | {first:.1f} s "
        f"| {max(early):.0f} to {max(late):.0f} MiB |"
    )


if __name__ == "__main__":
    main()
