"""Compare the speed of clpipe's default chain with the same work in OpenCV and NumPy.

    tools/run compare opencv [--device N] [--arrays WxH ...] [--files COUNTxWxH ...]

It needs the extra "compare" (.venv/bin/pip install -e '.[compare]'). opencv_chain.py lists
the OpenCV functions that replace each stage, and where OpenCV does less work. The OpenCV script
runs in two ways. The first works on whole images with OpenCV's own threads, like most scripts. The
second works in a pool of threads on bands of rows that fit into the cache. It was the fastest way
of those tried.

Arrays: a render of half floats in memory becomes an 8-bit picture in memory. clpipe also runs from
device to device, like `clpipe bench`.

Files: half EXRs become JPEGs of the same quality and subsampling. clpipe hashes its inputs, writes
sidecars and syncs each file to the disk before it renames it; the script does none of this. The
script decodes with the OpenEXR package, which is at least as fast as cv2.imread. It encodes with
cv2.imencode, which is faster than Pillow. It uses the fastest of several numbers of threads. Links
to a few renders replace many files.

A round runs each candidate once, so that other load on the machine affects all of them. Speeds are
medians. Ratios are computed within rounds; the tables show their median and quartiles. First, both
programs develop the test image, and the script compares their pictures and noise.
"""

import argparse
import importlib.util
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from clpipe.base.errors import ClpipeError
from clpipe.base.processors import available_processors
from clpipe.base.types import Array
from clpipe.batch.bench import Workload, write_renders
from clpipe.batch.outcome import DONE
from clpipe.batch.sinks import Folder
from clpipe.batch.threads import Batch
from clpipe.batch.work import ImageWorker
from clpipe.chain.request import Request
from clpipe.commands.printing import show
from clpipe.engine.bench import scene
from clpipe.engine.device import Device, open_device
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.images.read import read_image
from clpipe.inputs.find import find_jobs
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.writer import OutputWriter
from tools import RENDER
from tools.compare.timing import Comparison, Work, interleaved
from tools.shared.options import count_of, numbers_of, parser_of

NEEDED = ("cv2", "OpenEXR")
WHOLE, BANDS = "opencv_whole", "opencv_bands"
HEADINGS = (
    *("work", "clpipe MP/s"),
    *("OpenCV MP/s", "ratio", "quartiles", "in bands MP/s", "ratio", "quartiles"),
)


class Likeness(NamedTuple):
    """The similarity of clpipe's and the script's results.

    Args:
        difference: the mean absolute difference of their pictures of the test image, in levels.
        noise: the variance of the script's noise in a grey raw, relative to clpipe's.
    """

    difference: float
    noise: float


def likeness(device: Device) -> Likeness:
    """Compare the results of both."""
    from tools.compare.opencv_chain import OpenCVChain

    chain = Request.from_options().chain()
    script = OpenCVChain(chain)
    render = read_image(RENDER).pixels
    ours, theirs = Runner(chain, device).run(render, "").image, script.run_in_bands(render)
    grey = np.full((512, 512, 3), 0.18, np.float16)
    raw = Request.from_options(until="quantize").chain()
    own = (
        Runner(raw, None, encode=False, final=True).run(grey, "").image
    )  # same result as on the device
    return Likeness(
        float(abs(ours.astype(np.int16) - theirs).mean()),
        variance(script.expose(script.blur(grey))) / variance(own),
    )


def variance(raw: Array) -> float:
    """Return the mean variance of the colours of a uniform mosaic."""
    return float(np.mean([raw[i::2, j::2].astype(float).var() for i in (0, 1) for j in (0, 1)]))


def compare_arrays(device: Device, width: int, height: int, repeat: int) -> list[Comparison]:
    """Time arrays, once on the device only and once from memory to memory."""
    import cv2

    from tools.compare.opencv_chain import OpenCVChain, pool

    chain = Request.from_options().chain()
    runner, script = Runner(chain, device), OpenCVChain(chain)
    image = scene(width, height)
    with pool(available_processors()) as threads:

        def whole() -> None:
            cv2.setNumThreads(available_processors())
            script.run(image)

        def bands() -> None:
            cv2.setNumThreads(1)
            script.run_in_bands(image, threads.map)

        works: dict[str, Work] = {
            "memory": lambda: runner.run(image, "compare"),
            "device": lambda: runner.run(image, "compare", RunOptions(download=False)),
            WHOLE: whole,
            BANDS: bands,
        }
        interleaved(works, 1)  # compiles, and touches memory
        seconds = interleaved(works, repeat)
    theirs = {name: seconds[name] for name in (WHOLE, BANDS)}
    megapixels, size = width * height / 1e6, f"{width}x{height}"
    return [
        Comparison(f"{size}, on the device", megapixels, seconds["device"], theirs),
        Comparison(f"{size}, memory to memory", megapixels, seconds["memory"], theirs),
    ]


class Files:
    """A set of files, which clpipe and the script develop."""

    def __init__(self, device: Device, workload: Workload, folder: Path) -> None:
        from tools.compare.opencv_chain import OpenCVChain

        self.out = folder / "out"
        write_renders(folder / "in", workload)
        request = replace(Request.from_options(), formats=("jpg",))
        self.loader = ImageLoader(request)
        self.writer = OutputWriter(self.out, request)
        self.jobs = find_jobs([str(folder / "in")], self.out)
        self.chain = self.loader.first_chain(self.jobs)
        self.device = device
        self.script = OpenCVChain(self.chain, bgr=True)
        self.threads = available_processors()

    def clear(self) -> None:
        """Empty the output directory."""
        shutil.rmtree(self.out, ignore_errors=True)
        self.out.mkdir()

    def clpipe(self, count: int | None = None) -> None:
        """Develop the first ``count`` files with clpipe.

        Raises:
            ClpipeError: a file fails.
        """
        worker = ImageWorker(self.loader, Folder(self.writer), self.chain)
        for outcome in Batch(worker, [self.device]).run(self.jobs[:count]):
            if outcome.status != DONE:
                raise ClpipeError(outcome.error)

    def opencv(self, bands: bool, count: int | None = None) -> None:
        """Develop the first ``count`` files with the script."""
        import cv2
        import OpenEXR

        from tools.compare.opencv_chain import pool

        cv2.setNumThreads(1)
        quality = cv2.IMWRITE_JPEG_QUALITY, 97
        sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422

        def one(path: Path) -> None:
            render = OpenEXR.File(str(path)).channels()["RGB"].pixels
            picture = self.script.run_in_bands(render) if bands else self.script.run(render)
            _, data = cv2.imencode(".jpg", picture, (*quality, *sampling))
            data.tofile(self.out / f"{path.stem}.jpg")

        with pool(self.threads) as threads:
            list(threads.map(one, [job.path for job in self.jobs[:count]]))

    def choose_threads(self) -> None:
        """Choose the number of threads that is fastest for the script."""
        processors = available_processors()
        seconds = {}
        for self.threads in (processors, processors + 1, 2 * processors):
            self.clear()
            start = time.perf_counter()
            self.opencv(bands=True, count=2 * processors)
            seconds[self.threads] = time.perf_counter() - start
        self.threads = min(seconds, key=seconds.__getitem__)


def compare_files(device: Device, workload: Workload, repeat: int) -> Comparison:
    """Files to files."""
    with tempfile.TemporaryDirectory(prefix="clpipe-compare-") as name:
        files = Files(device, workload, Path(name))
        files.clear()
        files.clpipe(count=8)  # compiles kernels, and loads the files into the page cache
        files.choose_threads()
        works: dict[str, Work] = {
            "clpipe": files.clpipe,
            WHOLE: lambda: files.opencv(bands=False),
            BANDS: lambda: files.opencv(bands=True),
        }
        seconds = interleaved(works, repeat, files.clear)
    return Comparison(
        f"{workload.images} files of {workload.width}x{workload.height}, {files.threads} threads",
        workload.images * workload.width * workload.height / 1e6,
        seconds.pop("clpipe"),
        seconds,
    )


def load_of(text: str) -> Workload:
    """Parse COUNTxWIDTHxHEIGHT, with an even width and height.

    Raises:
        argparse.ArgumentTypeError: the text has another form.
    """
    return Workload(*even(numbers_of(text, "COUNTxWIDTHxHEIGHT"), text))


def size_of(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT, both even.

    Raises:
        argparse.ArgumentTypeError: the text has another form.
    """
    width, height = even(numbers_of(text, "WIDTHxHEIGHT"), text)
    return width, height


def even(numbers: list[int], text: str) -> list[int]:
    """Check that the last two numbers of a text are even."""
    if any(number % 2 for number in numbers[-2:]):
        raise argparse.ArgumentTypeError(f"found {text!r}; the script needs even sizes")
    return numbers


def main() -> int:
    """Compare, and print the tables."""
    parser = parser_of(__doc__)
    add = parser.add_argument
    add("--device", metavar="N|NAME", help="like clpipe's --device")
    sizes = [(3000, 2000), (6000, 4000)]
    text = "sizes of images in memory; without values, skip this comparison"
    add("--arrays", nargs="*", type=size_of, metavar="WxH", default=sizes, help=text)
    loads = [Workload(20, 6000, 4000), Workload(1000, 512, 512), Workload(200, 1920, 1080)]
    text = "numbers and sizes of files; none for no such comparison"
    add("--files", nargs="*", type=load_of, metavar="COUNTxWxH", default=loads, help=text)
    add("--repeat", type=count_of, default=5, metavar="N", help="rounds of each comparison [5]")
    options = parser.parse_args()
    try:
        if missing := [name for name in NEEDED if not importlib.util.find_spec(name)]:
            text = f"{', '.join(missing)}: missing; .venv/bin/pip install -e '.[compare]'"
            raise ClpipeError(text)
        return compare(options)
    except ClpipeError as error:
        print(error, file=sys.stderr)
        return 1


def compare(options: argparse.Namespace) -> int:
    """Run the selected comparisons.

    Raises:
        ClpipeError: there is no such device, or it fails.
    """
    import cv2

    device = open_device(options.device)
    if device is None:
        raise ClpipeError("--device numpy cannot be timed; choose an OpenCL device")
    alike = likeness(device)
    rows = []
    for size in options.arrays:
        rows += compare_arrays(device, *size, options.repeat)
    rows += [compare_files(device, workload, options.repeat) for workload in options.files]
    print(
        f"{device.info.label}, OpenCV {cv2.__version__}, {available_processors()} CPUs\n"
        f"pictures of the test image differ by {alike.difference:.1f} levels of 255 on average; "
        f"noise in the raw: {alike.noise:.3f} of clpipe's variance\n"
    )
    if rows:
        show(HEADINGS, [row.cells() for row in rows], left=1)
    return 0


if __name__ == "__main__":
    sys.exit(main())
