"""How near a batch comes to what the machine can do: the same work serially and in threads."""

import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.batch.outcome import DONE, STEPS
from clpipe.batch.threads import Batch
from clpipe.chain.request import Request
from clpipe.engine.bench import scene
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.images.read import decode_first_part
from clpipe.images.tags import Tags
from clpipe.images.write import write_display, write_exr
from clpipe.inputs.find import find_jobs
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind

CODED = 100  # images by which the codecs are timed alone


TRANSFERS = ("upload", "download")


DISTINCT = 4  # renders; the other names are links to them


@dataclass(frozen=True)
class Load:
    """So many images of one size."""

    images: int
    width: int
    height: int


def loads() -> tuple[Load, ...]:
    """Patches, frames and photographs."""
    return Load(1000, 512, 512), Load(200, 1920, 1080), Load(20, 6000, 4000)


@dataclass(frozen=True)
class BatchSpeed:
    """One load, measured.

    ``cpu_ms`` is each step's CPU time of an image in the serial run; ``limit_s`` their sum over the
    processors, for all images. ``alone_ms`` is what the file's decoder and encoder take alone, and
    the kernels there; ``overhead_ms`` what an image takes serially beyond them.
    """

    images: int
    width: int
    height: int
    serial_s: float
    batch_s: float
    limit_s: float
    cpu_ms: dict[str, float]
    alone_ms: dict[str, float]
    overhead_ms: float
    peak_mib: float

    @property
    def share_of_limit(self) -> float:
        """How near the batch comes to the limit; 1 is there."""
        return self.limit_s / self.batch_s

    @property
    def megapixels_per_second(self) -> float:
        """Of the batch."""
        return self.images * self.width * self.height / 1e6 / self.batch_s

    def record(self) -> dict[str, Any]:
        """The same as JSON values."""
        ratios = {
            "share_of_limit": self.share_of_limit,
            "mp_per_s": self.megapixels_per_second,
            "batch_over_serial": self.serial_s / self.batch_s,
        }
        return asdict(self) | ratios


class _Clock:
    """Time and CPU time of this process, summed by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu: dict[str, float] = {}

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        start, cpu = time.perf_counter(), time.process_time()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
        self.cpu[name] = self.cpu.get(name, 0.0) + time.process_time() - cpu


def bench_batch(device: Device, asked: Request, load: Load) -> BatchSpeed:
    """Time one load: half EXR in, JPEG out; serially, in threads, and each part alone.

    The files lie in a temporary folder while it lasts.
    """
    with tempfile.TemporaryDirectory(prefix="clpipe-bench-") as name:
        folder = Path(name)
        write_renders(folder / "in", load)
        entrance = ImageLoader(asked)
        jobs = find_jobs([str(folder / "in")], folder / "out")
        chain = entrance.first_chain(jobs)

        def batch(trace: bool = False) -> Batch:
            shutil.rmtree(folder / "out", ignore_errors=True)
            (folder / "out").mkdir()
            target = OutputWriter(folder / "out", ("jpg",))
            return Batch(entrance, target, [device], chain, trace=trace)

        # A few first, so that nothing is compiled and no file is cold in what is timed.
        list(batch().run(jobs[: 2 * DISTINCT]))
        clock = _Clock()
        encoded = Runner(chain, device).run(decode_first_part(jobs[0].path), "").image
        tags = Tags(chain.camera.make, chain.camera.model, chain.iso)
        serial = []
        for outcome in batch(trace=True).one_by_one(jobs, clock.on):
            serial.append(outcome)
            if len(serial) % max(load.images // CODED, 1) == 0:
                # In between, for machines are not always as fast.
                with clock.on("decoder"):
                    decode_first_part(outcome.job.path)
                with clock.on("encoder"):
                    write_display(folder / "alone.jpg", encoded, tags)
        forget_peak_memory()
        with clock.on("batch"):
            threaded = list(batch().run(jobs))
        for outcome in (*serial, *threaded):
            if outcome.status != DONE:
                raise ImageError(outcome.error)
        peak = peak_memory()
        spans = [span for outcome in serial for span in outcome.spans]
        kernels = sum(s.seconds for s in spans if s.step not in (*STEPS, *TRANSFERS))
    n = load.images
    coded = n // max(n // CODED, 1)
    alone = {name: clock.seconds[name] / coded * 1e3 for name in ("decoder", "encoder")}
    alone["kernels"] = kernels / n * 1e3
    cpu = {step: clock.cpu[step] / n * 1e3 for step in STEPS}
    serial_s = sum(clock.seconds[step] for step in STEPS)
    return BatchSpeed(
        n,
        load.width,
        load.height,
        serial_s=serial_s,
        batch_s=clock.seconds["batch"],
        limit_s=sum(clock.cpu[step] for step in STEPS) / len(os.sched_getaffinity(0)),
        cpu_ms=cpu,
        alone_ms=alone,
        overhead_ms=serial_s / n * 1e3 - sum(alone.values()),
        peak_mib=peak / 2**20,
    )


def forget_peak_memory() -> None:
    """Let the peak of this process's memory begin anew (Linux, proc(5): clear_refs)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> int:
    """The most memory that this process held, in bytes; 0 where the system does not say it."""
    try:
        found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    except OSError:
        found = None
    return int(found[1]) * 1024 if found else 0


def write_renders(folder: Path, load: Load) -> None:
    """A folder of renders in half floats; a few, and links to them."""
    folder.mkdir()
    picture = scene(load.width, load.height)
    digits = len(str(load.images - 1))
    for i in range(load.images):
        path = folder / f"{i:0{digits}}.exr"
        if i < DISTINCT:
            rolled = np.roll(picture, 37 * i, axis=1)
            write_exr(path, rolled, Kind.RGB.channels, {}, half=True)
        else:
            path.symlink_to(f"{i % DISTINCT:0{digits}}.exr")
