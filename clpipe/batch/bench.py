"""Benchmark of whole batches: how near threads come to the limit that their CPU time sets."""

import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.errors import ImageError
from clpipe.base.processors import available_processors
from clpipe.batch.outcome import DONE, STEPS, Outcome
from clpipe.batch.threads import Batch
from clpipe.batch.work import ImageWorker
from clpipe.chain.request import Request
from clpipe.engine.bench import scene
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.images.read import decode_first_part
from clpipe.images.tags import Tags
from clpipe.images.write import write_display, write_exr
from clpipe.inputs.find import Job, find_jobs
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind

CODED = 100  # images on which the decoder and the encoder are timed alone

TRANSFERS = ("upload", "download")

DISTINCT = 4  # renders; the others are links to them


@dataclass(frozen=True)
class Load:
    """A number of images of one size in pixels."""

    images: int
    width: int
    height: int


def loads() -> tuple[Load, ...]:
    """The loads of ``clpipe bench --batch``: patches, frames and photographs."""
    return Load(1000, 512, 512), Load(200, 1920, 1080), Load(20, 6000, 4000)


@dataclass(frozen=True)
class BatchSpeed:
    """The speed of one load.

    Args:
        images, width, height: the load.
        serial_s: how long its images take one after the other.
        batch_s: how long they take in threads.
        limit_s: the CPU time of the serial run, divided by the number of processors.
        cpu_ms: the CPU time of an image in the serial run, by step.
        alone_ms: what the decoder, the encoder and the kernels take alone, for an image.
        overhead_ms: what an image takes serially beyond these.
        peak_mib: the most memory that the process held in threads.
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
        """How near the batch comes to the limit; 1 is at the limit."""
        return self.limit_s / self.batch_s

    @property
    def megapixels_per_second(self) -> float:
        """The speed of the batch."""
        return self.images * self.width * self.height / 1e6 / self.batch_s

    def record(self) -> dict[str, Any]:
        """The speeds and their ratios as JSON values."""
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


def bench_batch(device: Device, request: Request, load: Load) -> BatchSpeed:
    """Time one load: half EXR in, JPEG out; serially, in threads, and each part alone.

    The files lie in a temporary folder while it lasts.
    """
    with tempfile.TemporaryDirectory(prefix="clpipe-bench-") as name:
        folder = Path(name)
        write_renders(folder / "in", load)
        loader = ImageLoader(request)
        writer = OutputWriter(folder / "out", replace(request, formats=("jpg",)))
        jobs = find_jobs([str(folder / "in")], folder / "out")
        chain = loader.first_chain(jobs)

        def worker(trace: bool = False) -> ImageWorker:
            shutil.rmtree(folder / "out", ignore_errors=True)
            (folder / "out").mkdir()
            return ImageWorker(loader, writer, chain, trace=trace)

        # A few first, so that nothing is compiled and no file is cold in what is timed.
        list(Batch(worker(), [device]).run(jobs[: 2 * DISTINCT]))
        clock = _Clock()
        encoded = Runner(chain, device).run(decode_first_part(jobs[0].path), "").image
        tags = Tags(chain.camera.make, chain.camera.model, chain.iso)
        serial = []
        for outcome in one_by_one(worker(trace=True), device, jobs, clock.on):
            serial.append(outcome)
            if len(serial) % max(load.images // CODED, 1) == 0:
                # In between, because the speed of machines changes with time.
                with clock.on("decoder"):
                    decode_first_part(outcome.job.path)
                with clock.on("encoder"):
                    write_display(folder / "alone.jpg", encoded, tags)
        forget_peak_memory()
        batch = Batch(worker(), [device])
        with clock.on("batch"):
            threaded = list(batch.run(jobs))
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
        limit_s=sum(clock.cpu[step] for step in STEPS) / available_processors(),
        cpu_ms=cpu,
        alone_ms=alone,
        overhead_ms=serial_s / n * 1e3 - sum(alone.values()),
        peak_mib=peak / 2**20,
    )


def one_by_one(
    worker: ImageWorker,
    device: Device | None,
    jobs: Sequence[Job],
    on: Callable[[str], AbstractContextManager[None]],
) -> Iterator[Outcome]:
    """Do jobs serially in this thread, which batches are measured against.

    Args:
        worker: what is done to each image.
        device: where to develop.
        jobs: the images.
        on: entered around each step of each image, with the step's name.
    """
    worker.reserve(1)
    runners = worker.runners(device)
    for job in jobs:
        with on("decode"):
            task = worker.decode(job, lambda: None)
        for rendition in task.renditions:
            with on("device"):
                result = worker.develop(task, rendition, runners.of(rendition))
            if result:
                with on("encode"):
                    worker.encode(task, rendition, result, device)
        yield task.outcome()


def forget_peak_memory() -> None:
    """Reset the peak of this process's memory (Linux, proc(5): clear_refs)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", "utf-8")


def peak_memory() -> int:
    """The most memory that this process held, in bytes; 0 where the system has no /proc."""
    try:
        match = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text("utf-8"))
    except OSError:
        match = None
    return int(match[1]) * 1024 if match else 0


def write_renders(folder: Path, load: Load) -> None:
    """Write a folder of renders in half floats: :data:`DISTINCT` files, and links to them."""
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
