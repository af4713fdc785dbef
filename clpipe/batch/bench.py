"""Benchmark of whole batches: their speed, and the CPU time of each step."""

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

# Steps that take CPU time, in order. "Python" is the time outside the other steps.
CPU_STEPS = (
    *("decode", "convert", "hash", "upload", "kernels", "download", "encode", "write"),
    "Python",
)

DISTINCT_RENDERS = 4  # distinct renders; further renders are links to them


@dataclass(frozen=True)
class Workload:
    """A number of images of one size in pixels."""

    images: int
    width: int
    height: int


def workloads() -> tuple[Workload, ...]:
    """Return the workloads of ``clpipe bench --batch``: patches, frames and photographs."""
    return Workload(1000, 512, 512), Workload(200, 1920, 1080), Workload(20, 6000, 4000)


@dataclass(frozen=True)
class BatchSpeed:
    """The speed of one workload.

    Args:
        images, width, height: the workload.
        seconds: the time that its images take.
        cpu_ms: the CPU time per image in ms, by step, see :data:`CPU_STEPS`.
        processors: the number of processors that the process may use.
        peak_mib: the peak memory of the process in MiB; None outside Linux.
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
        """The share of the processors' time that the steps account for, 0 to 1."""
        return sum(self.cpu_ms.values()) * self.images / 1e3 / (self.seconds * self.processors)

    @property
    def megapixels_per_second(self) -> float:
        """The speed of the batch, in megapixels per second."""
        return self.images * self.width * self.height / 1e6 / self.seconds

    def record(self) -> dict[str, Any]:
        """Return the speeds and their ratios as JSON values."""
        return asdict(self) | {"busy": self.busy, "mp_per_s": self.megapixels_per_second}


def bench_batch(device: Device, request: Request, workload: Workload) -> BatchSpeed:
    """Time one workload from half-float EXR to JPEG, with the CPU time of each step.

    Thread clocks measure the time of a step. On a CPU, the driver's threads run kernels and
    transfers. Their time is the process's time minus our threads' time. It is divided between
    kernels, which use all compute units, and transfers, which use one. "Python" is the time of our
    threads outside all steps.

    The files are in a temporary folder.
    """
    with tempfile.TemporaryDirectory(prefix="clpipe-bench-") as name:
        folder = Path(name)
        chain = request.chain()
        picture = benchmark_image(chain, workload.width, workload.height)
        write_images(folder / "in", workload, picture, chain.source)
        loader = ImageLoader(request)
        jobs = find_jobs([str(folder / "in")], folder / "out")
        resolved = replace(request, formats=("jpg",)).with_outputs(chain)
        writer = OutputWriter(folder / "out", resolved)

        def batch() -> Batch:
            shutil.rmtree(folder / "out", ignore_errors=True)
            (folder / "out").mkdir()
            return Batch(ImageWorker(loader, Folder(writer), chain, trace=True), [device])

        # Run a short batch first, to compile kernels and cache files before the timing.
        list(batch().run(jobs[: 2 * DISTINCT_RENDERS]))
        reset_peak_memory()
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
        workload.images,
        workload.width,
        workload.height,
        seconds=seconds,
        cpu_ms={step: cpu[step] / workload.images * 1e3 for step in CPU_STEPS},
        processors=available_processors(),
        peak_mib=None if peak is None else peak / 2**20,
    )


def driver_shares(spans: Iterable[Span], compute_units: int) -> dict[str, float]:
    """Return the shares of transfers and kernels in the CPU time of a driver. The sum is 1.

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


def reset_peak_memory() -> None:
    """Reset the peak of this process's memory (Linux, proc(5): clear_refs)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", "utf-8")


def write_renders(folder: Path, workload: Workload) -> None:
    """Write a folder of renders in half floats, see :func:`write_images`."""
    write_images(folder, workload, scene(workload.width, workload.height), Kind.RGB)


def write_images(folder: Path, workload: Workload, picture: Array, kind: Kind) -> None:
    """Write a folder of variants of an image: :data:`DISTINCT_RENDERS` files, and links to them.

    If links are not allowed, as for most users of Windows, the files are copied.
    """
    folder.mkdir()
    attributes = {} if kind is Kind.RGB else {"kind": kind.label}
    digits = len(str(workload.images - 1))
    for i in range(workload.images):
        path = folder / f"{i:0{digits}}.exr"
        if i < DISTINCT_RENDERS:
            shifted_picture = np.roll(picture, 37 * i, axis=1)
            write_exr(
                path, shifted_picture, kind.channels, attributes, half=picture.dtype == np.float16
            )
        else:
            first = f"{i % DISTINCT_RENDERS:0{digits}}.exr"
            try:
                path.symlink_to(first)
            except OSError:
                shutil.copyfile(folder / first, path)
