"""Compare the speed of a development chain with the same work in Halide.

    tools/run compare halide [--device N] [--size WxH] [--repeat N]

It needs the extra "compare" (.venv/bin/pip install -e '.[compare]'). Both develop a Bayer raw into
an 8-bit picture: levels, white balance, demosaicing (malvar2004), colour matrix, sharpening, tone
curve and gamma. halide_chain.py lists what each does differently. Halide computes in 16 and 32-bit
integers, clpipe in 32-bit floats. Halide runs with a schedule written by hand and with those of its
autoschedulers.

Both run from memory to memory, on two bytes per pixel for Halide and four for clpipe. A round runs
each candidate once, so that other load on the machine affects all of them.
"""

import importlib.util

import numpy as np

from clpipe.base.processors import available_processors
from clpipe.chain.making import make_chain
from clpipe.chain.settings import settings_from
from clpipe.commands.printing import show
from clpipe.engine.bench import benchmark_image
from clpipe.engine.device import open_device
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.stage import Kind
from tools.compare.timing import Comparison, Work, interleaved
from tools.shared.options import count_of, parser_of, sides_of

STAGES = ("normalize", "white_balance", "demosaic", "color_matrix")
STAGES += ("sharpen", "tone_curve", "gamma")


def main() -> None:
    """Time both, and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--device")
    parser.add_argument("--size", type=sides_of, default=(6000, 4000), metavar="WxH")
    parser.add_argument("--repeat", type=count_of, default=15, help="rounds [15]")
    options = parser.parse_args()
    if not importlib.util.find_spec("halide"):
        parser.error("this comparison needs Halide: .venv/bin/pip install -e '.[compare]'")
    from tools.compare.halide_chain import AUTOSCHEDULERS, BAND, HalideChain

    width, height = options.size
    if width % 2 or height % BAND:
        parser.error(f"--size: the width must be even, and the height a multiple of {BAND}")
    settings = settings_from({"stages": list(STAGES), "demosaic": {"method": "malvar2004"}})
    chain = make_chain(settings, Kind.RAW)
    device = open_device(options.device)
    if not device:
        parser.error("this comparison needs an OpenCL device")
    runner, raw = Runner(chain, device), benchmark_image(chain, width, height)
    integers, cores = raw.astype(np.uint16), available_processors()
    into = np.empty((height, width, 3), np.uint8)
    schedules = {}
    for name in ("by hand", *AUTOSCHEDULERS):
        schedules[name] = HalideChain(chain, width, height, name, cores)
    ours = runner.run(raw, "k").image
    works: dict[str, Work] = {
        "clpipe": lambda: runner.run(raw, "k", RunOptions(into=into)),
        "clpipe, on the device": lambda: runner.run(raw, "k", RunOptions(download=False)),
    }
    for name, each in schedules.items():
        theirs = np.empty_like(into)
        each(integers, theirs)
        difference = np.abs(ours.astype(int) - theirs)[8:-8, 8:-8]
        print(f"Halide, {name}: differs by {difference.mean():.2f} levels of 255 on average")
        works[f"Halide, {name}"] = lambda each=each, theirs=theirs: each(integers, theirs)
    for work in works.values():
        work()
    seconds = interleaved(works, options.repeat)
    mine = seconds.pop("clpipe")
    result = Comparison(f"{width}x{height}", width * height / 1e6, mine, seconds)
    rows = [("clpipe", f"{result.speed(mine):.0f}", "1.00", "")]
    for name, own in seconds.items():
        low, median, high = (f"{1 / ratio:.2f}" for ratio in result.ratios(name))
        rows.append((name, f"{result.speed(own):.0f}", median, f"{high} to {low}"))
    print(f"\n{width}x{height}, {device.info.label}, {cores} processors\n")
    show(("", "MP/s", "over clpipe", "quartiles"), rows)


if __name__ == "__main__":
    main()
