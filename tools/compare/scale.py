"""Measure how a run scales with processes, and model a machine with 64 processors.

    sh tools/scale [--sizes 512x512,640x480,1920x1080] [--images 600] [--processors 64]

For each size, half EXRs become JPEGs:

- by one process, to measure the CPU time of Python code in its threads. This code holds the
  interpreter's lock, so no other thread of the process can use that time.
- by 1, 2 and 4 processes, to measure images per second and the CPU time per image. Workers and the
  parent process, which distributes the images, are measured separately. Runs with few images give
  the time to start, which is subtracted.

In the model, a run with C processors and N processes makes this many images per second: the minimum
of C / (CPU time per image), N / (locked time per image) and 1 / (parent's time per image). It
assumes that processors are as fast together as singly, and that disk and memory keep up.
"""

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from clpipe.base.processors import available_processors
from clpipe.batch.bench import Workload, bench_batch, write_renders
from clpipe.batch.processes import default_processes
from clpipe.chain.request import Request
from clpipe.engine.device import open_device
from clpipe.images.claims import mosaic_claim
from tools.shared.options import count_of, parser_of, sides_of
from tools.shared.tables import markdown

COUNTS = (1, 2, 4)
FEW = 40  # images, to measure the time to start
PROGRAM = """
import resource, sys, clpipe
inputs, output, processes = sys.argv[1:4]
made = clpipe.run(inputs, output, processes=int(processes))
assert all(outcome.status == "done" for outcome in made)
print(*(resource.getrusage(who).ru_utime + resource.getrusage(who).ru_stime
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)), made.summary.elapsed)
"""


@dataclass(frozen=True)
class RunTime:
    """The times of a run, in s: CPU time of the parent and of its children, and elapsed time."""

    parent: float
    children: float
    elapsed: float


@dataclass(frozen=True)
class Cost:
    """The time per image, in ms.

    Args:
        cpu: CPU time of the workers.
        parent: CPU time of the process that distributes images.
        elapsed: from one image to the next.
    """

    cpu: float
    parent: float
    elapsed: float


def run(folder: Path, images: int, processes: int) -> RunTime:
    """Process the first images of a folder, and return the times."""
    with tempfile.TemporaryDirectory(dir=folder) as out:
        inputs = folder / f"first{images}.csv"
        names = sorted(path.name for path in (folder / "in").iterdir())[:images]
        inputs.write_text("path\n" + "".join(f"in/{name}\n" for name in names), "utf-8")
        command = [sys.executable, "-c", PROGRAM, str(inputs), f"{out}/out", str(processes)]
        printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return RunTime(*map(float, printed.split()))


def cost_of(folder: Path, images: int, processes: int) -> Cost:
    """Measure the time per image, without the time to start."""
    few, many = (run(folder, count, processes) for count in (FEW * processes, images))
    per_image = 1e3 / (images - FEW * processes)
    parent = (many.parent - few.parent) * per_image
    children = (many.children - few.children) * per_image
    elapsed = (many.elapsed - few.elapsed) * per_image
    return Cost(parent, 0.0, elapsed) if processes == 1 else Cost(children, parent, elapsed)


def locked_time(load: Workload) -> float:
    """Return an upper bound of the time per image under the interpreter's lock, in ms.

    It is the CPU time of all threads outside of decoding, hashing, kernels, encoding and writing.
    These steps run without the lock, apart from small parts. The figure includes system calls.
    """
    device = open_device(None)
    assert device
    return bench_batch(device, Request.from_options(), load).cpu_ms["Python"]


def modelled(cost: Cost, lock: float, processors: int, processes: int) -> float:
    """Return the images per second of the module's model.

    >>> round(modelled(Cost(10.0, 0.25, 5.0), 2.0, 64, 1))
    500
    >>> round(modelled(Cost(10.0, 0.25, 5.0), 2.0, 64, 32))
    4000
    """
    parent = 1e3 / cost.parent if cost.parent else float("inf")
    return min(processors / cost.cpu * 1e3, processes / lock * 1e3, parent)


def main() -> None:
    """Measure, and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--sizes", default="512x512,640x480,1920x1080", help="[%(default)s]")
    parser.add_argument("--images", type=count_of, default=600, help="of each size [600]")
    parser.add_argument("--processors", type=count_of, default=64, help="of the model [64]")
    options = parser.parse_args()
    here = available_processors()
    print(f"{here} processors; {options.images} images; CPU times in ms per image\n")
    rows, models = [], []
    for text in options.sizes.split(","):
        width, height = sides_of(text)
        with tempfile.TemporaryDirectory(prefix="clpipe-scale-") as name:
            folder = Path(name)
            write_renders(folder / "in", Workload(options.images, width, height))
            run(folder, FEW, 1)  # compiles kernels and loads files
            lock = locked_time(Workload(options.images, width, height))
            costs = {count: cost_of(folder, options.images, count) for count in COUNTS}
        for count, cost in costs.items():
            numbers = f"{cost.cpu:.2f}", f"{cost.parent:.2f}", f"{1e3 / cost.elapsed:.0f}"
            rows.append([text, f"{lock:.2f}", count, *numbers])
        claim = mosaic_claim(width, height)
        usual = default_processes(10**6, claim, options.processors)
        single = modelled(costs[1], lock, options.processors, 1)
        shared = modelled(costs[here if here in costs else 2], lock, options.processors, usual)
        models.append([text, f"{single:.0f}", usual, f"{shared:.0f}"])
    heads = ["size", "locked, at most", "processes", "workers", "parent", "images/s here"]
    print(markdown(heads, rows))
    print(f"\nModel of {options.processors} processors:\n")
    heads = ["size", "one process, images/s", "processes by default", "images/s"]
    print(markdown(heads, models))


if __name__ == "__main__":
    main()
