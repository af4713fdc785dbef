"""How far a run scales with processes: what the lock takes, what all takes, and 64 processors.

    sh tools/scale [--sizes 512x512,640x480,1920x1080] [--images 600] [--processors 64]

For each size, images of half EXR become JPEGs:

- by one process, with the clocks of its threads: what is Python's holds the interpreter's lock,
  and no other thread of the process can use that time;
- by 1, 2 and 4 processes: images a second here, and ms of CPU time of an image, of the processes
  and of the one that hands out and takes in. What starting takes is measured with few images, and
  taken off.

The model: with C processors and N processes a run makes as many images a second as the least of
C / (CPU time of an image), N / (time under the lock) and 1 / (time of the one that hands out). It
takes for granted that processors are as fast side by side as alone, and that disk and memory keep
up.
"""

import argparse
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from clpipe.base.processors import available_processors
from clpipe.batch.bench import Load, bench_batch, write_renders
from clpipe.batch.processes import usual_processes
from clpipe.chain.request import Request
from clpipe.engine.device import open_device
from clpipe.images.claims import mosaic_claim

COUNTS = (1, 2, 4)
FEW = 40  # images, by which starting is measured
PROGRAM = """
import resource, sys, clpipe
inputs, output, processes = sys.argv[1:4]
made = clpipe.run(inputs, output, processes=int(processes))
assert all(outcome.status == "done" for outcome in made)
print(*(resource.getrusage(who).ru_utime + resource.getrusage(who).ru_stime
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)), made.summary.elapsed)
"""


@dataclass(frozen=True)
class Taken:
    """What a run took, in s: of CPU time of the first process and of the others, and in all."""

    own: float
    others: float
    elapsed: float


@dataclass(frozen=True)
class Cost:
    """What an image costs, in ms.

    Args:
        cpu: of the processes that make it.
        handing: of the one that hands it out.
        elapsed: from one image to the next.
    """

    cpu: float
    handing: float
    elapsed: float


def run(folder: Path, images: int, processes: int) -> Taken:
    """A run over the first images of a folder."""
    with tempfile.TemporaryDirectory(dir=folder) as out:
        inputs = folder / f"first{images}.csv"
        names = sorted(path.name for path in (folder / "in").iterdir())[:images]
        inputs.write_text("path\n" + "".join(f"in/{name}\n" for name in names), "utf-8")
        command = [sys.executable, "-c", PROGRAM, str(inputs), f"{out}/out", str(processes)]
        said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return Taken(*map(float, said.split()))


def cost_of(folder: Path, images: int, processes: int) -> Cost:
    """What an image costs, without what starting takes."""
    few, many = (run(folder, count, processes) for count in (FEW * processes, images))
    per_image = 1e3 / (images - FEW * processes)
    own, others = (many.own - few.own) * per_image, (many.others - few.others) * per_image
    elapsed = (many.elapsed - few.elapsed) * per_image
    return Cost(own, 0.0, elapsed) if processes == 1 else Cost(others, own, elapsed)


def locked(load: Load) -> float:
    """For how many ms of an image a process holds the interpreter's lock, at most.

    It is the CPU time of all threads outside of decoding, hashing, kernels, encoding and writing,
    which run without the lock; system calls are in it, and small parts of those steps are not.
    """
    device = open_device(None)
    assert device
    return bench_batch(device, Request.from_options(), load).cpu_ms["Python"]


def modelled(cost: Cost, lock: float, processors: int, processes: int) -> float:
    """Images a second by the model, see the module.

    >>> round(modelled(Cost(10.0, 0.25, 5.0), 2.0, 64, 1))
    500
    >>> round(modelled(Cost(10.0, 0.25, 5.0), 2.0, 64, 32))
    4000
    """
    handing = 1e3 / cost.handing if cost.handing else float("inf")
    return min(processors / cost.cpu * 1e3, processes / lock * 1e3, handing)


def main() -> None:
    """Measure, and print tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", default="512x512,640x480,1920x1080")
    parser.add_argument("--images", type=int, default=600)
    parser.add_argument("--processors", type=int, default=64)
    asked = parser.parse_args()
    here = available_processors()
    print(f"{here} processors; {asked.images} images; ms of CPU time an image, images a second\n")
    print("| size | under the lock, at most | processes | CPU | handing out | images/s here |")
    print("|---|---|---|---|---|---|")
    models = []
    for text in asked.sizes.split(","):
        width, height = map(int, text.split("x"))
        with tempfile.TemporaryDirectory(prefix="clpipe-scale-") as name:
            folder = Path(name)
            write_renders(folder / "in", Load(asked.images, width, height))
            run(folder, FEW, 1)  # kernels are compiled, files read
            lock = locked(Load(asked.images, width, height))
            costs = {count: cost_of(folder, asked.images, count) for count in COUNTS}
        for count, cost in costs.items():
            numbers = f"{cost.cpu:.2f} | {cost.handing:.2f} | {1e3 / cost.elapsed:.0f}"
            print(f"| {text} | {lock:.2f} | {count} | {numbers} |", flush=True)
        claim = mosaic_claim(width, height)
        usual = usual_processes(10**6, claim, asked.processors)
        alone = modelled(costs[1], lock, asked.processors, 1)
        shared = modelled(costs[here if here in costs else 2], lock, asked.processors, usual)
        models.append(f"| {text} | {alone:.0f} | {usual} | {shared:.0f} |")
    print(f"\nBy the model, on {asked.processors} processors:\n")
    print("| size | one process, images/s | processes by default | images/s |")
    print("\n".join(["|---|---|---|---|", *models]))


if __name__ == "__main__":
    main()
