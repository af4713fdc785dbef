"""Benchmark of whole batches: how fast they are, and what their CPU time goes into."""

import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from clpipe.base.cpu_time import CpuTimer, CpuTimes
from clpipe.base.errors import ImageError
from clpipe.base.memory import peak_memory
from clpipe.base.processors import available_processors
from clpipe.base.types import Array
from clpipe.batch.outcome import DONE, STEPS, Span
from clpipe.batch.sinks import Folder
from clpipe.batch.threads import Batch
from clpipe.batch.work import ImageWorker
from clpipe.chain.request import Request
from clpipe.engine.bench import benchmark_image, scene
from clpipe.engine.device import Device
from clpipe.images.write import write_exr
from clpipe.inputs.find import find_jobs
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind

TRANSFERS = ("upload", "download")

# What CPU time goes into, in the order of the work; "Python" is all that is not within another.
CPU_STEPS = (
    *("decode", "convert", "hash", "upload", "kernels", "download", "encode", "write"),
    "Python",
)

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
        seconds: how long its images take.
        cpu_ms: the CPU time of an image, by step, see :data:`CPU_STEPS`.
        processors: how many there are for the process.
        peak_mib: the most memory that the process held; None outside Linux.
    """

    images: int
    width: int
    height: int
    seconds: float
    cpu_ms: dict[str, float]
    processors: int
    peak_mib: float | None

    @property
    def busy(self) -> float:
        """The share of the processors' time that the steps explain; 1 is no time unexplained."""
        return sum(self.cpu_ms.values()) * self.images / 1e3 / (self.seconds * self.processors)

    @property
    def megapixels_per_second(self) -> float:
        """The speed of the batch."""
        return self.images * self.width * self.height / 1e6 / self.seconds

    def record(self) -> dict[str, Any]:
        """The speeds and their ratios as JSON values."""
        return asdict(self) | {"busy": self.busy, "mp_per_s": self.megapixels_per_second}


def bench_batch(device: Device, request: Request, load: Load) -> BatchSpeed:
    """Time one load: half EXR in, JPEG out, and the CPU time of each step.

    The time of a step is measured by the clocks of the threads that do it. On a CPU, the driver's
    threads run kernels and transfers. Their time is the process's time less that of our threads. It
    is divided between kernels, which take all compute units, and transfers, which take one.
    "Python" is the time of our threads outside all steps.

    The files lie in a temporary folder while it lasts.
    """
    with tempfile.TemporaryDirectory(prefix="clpipe-bench-") as name:
        folder = Path(name)
        chain = request.chain()
        picture = benchmark_image(chain, load.width, load.height)
        write_images(folder / "in", load, picture, chain.source)
        loader = ImageLoader(request)
        jobs = find_jobs([str(folder / "in")], folder / "out")
        resolved = replace(request, formats=("jpg",)).with_outputs(chain)
        writer = OutputWriter(folder / "out", resolved)

        def batch() -> Batch:
            shutil.rmtree(folder / "out", ignore_errors=True)
            (folder / "out").mkdir()
            return Batch(ImageWorker(loader, Folder(writer), chain, trace=True), [device])

        # A few first, so that nothing is compiled and no file is cold in what is timed.
        list(batch().run(jobs[: 2 * DISTINCT]))
        forget_peak_memory()
        timed = batch()
        start = time.perf_counter()
        with CpuTimes() as times, CpuTimer("Python"):
            outcomes = list(timed.run(jobs))
        seconds = time.perf_counter() - start
        peak = peak_memory()
    for outcome in outcomes:
        if outcome.status != DONE:
            raise ImageError(outcome.error)
    spans = [span for outcome in outcomes for span in outcome.spans if span.step not in STEPS]
    cpu = defaultdict(float, times.seconds)
    for step, share in driver_shares(spans, device.info.compute_units).items():
        cpu[step] += share * times.elsewhere
    return BatchSpeed(
        load.images,
        load.width,
        load.height,
        seconds=seconds,
        cpu_ms={step: cpu[step] / load.images * 1e3 for step in CPU_STEPS},
        processors=available_processors(),
        peak_mib=None if peak is None else peak / 2**20,
    )


def driver_shares(spans: Iterable[Span], compute_units: int) -> dict[str, float]:
    """How the CPU time of a driver is shared out between transfers and kernels; the sum is 1.

    >>> spans = [Span("upload", "", 0, 1.0), Span("demosaic", "", 0, 2.0)]
    >>> driver_shares(spans, compute_units=2)
    {'upload': 0.2, 'kernels': 0.8}
    """
    work: dict[str, float] = {}
    for span in spans:
        transfer = span.step in TRANSFERS
        name, units = (span.step, 1) if transfer else ("kernels", compute_units)
        work[name] = work.get(name, 0.0) + span.seconds * units
    total = sum(work.values())
    return {name: each / total for name, each in work.items()}


def forget_peak_memory() -> None:
    """Reset the peak of this process's memory (Linux, proc(5): clear_refs)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", "utf-8")


def write_renders(folder: Path, load: Load) -> None:
    """Write a folder of renders in half floats, as :func:`write_images`."""
    write_images(folder, load, scene(load.width, load.height), Kind.RGB)


def write_images(folder: Path, load: Load, picture: Array, kind: Kind) -> None:
    """Write a folder of images like one: :data:`DISTINCT` files, and links to them.

    They are copies where links cannot be made, as on Windows by most users.
    """
    folder.mkdir()
    attributes = {} if kind is Kind.RGB else {"kind": kind.label}
    digits = len(str(load.images - 1))
    for i in range(load.images):
        path = folder / f"{i:0{digits}}.exr"
        if i < DISTINCT:
            rolled = np.roll(picture, 37 * i, axis=1)
            write_exr(path, rolled, kind.channels, attributes, half=picture.dtype == np.float16)
        else:
            first = f"{i % DISTINCT:0{digits}}.exr"
            try:
                path.symlink_to(first)
            except OSError:
                shutil.copyfile(folder / first, path)
