"""Time clpipe.Stream: at the rate of a camera by chain, and as fast as it can by size.

sh tools/run pages live --seconds 60

The first table has pictures per second, latency and dropped frames. The second one has the time of
a call, and the pictures per second of put and get.
"""

import threading
import time

import numpy as np

import clpipe
from tools.shared.options import parser_of, sides_of
from tools.shared.tables import markdown

LOOPS = {"exposure": {"method": "auto"}, "control": {"iso_max": 3200.0}}
BALANCE = {"white_balance": {"method": "gray_world"}}
CHAINS: dict[str, dict] = {
    "default": {},
    "auto exposure and ISO": LOOPS,
    "auto exposure, ISO and white balance": {**LOOPS, **BALANCE},
    "eight-bit sRGB frames": {"transfer": "srgb"},
    "raw": {"until": "quantize"},
    "-c video": {"config": "video"},
}

SIZES = ((160, 120), (320, 240), (640, 480), (1280, 720), (1920, 1080))
FAST = ("default", "raw", "auto exposure and ISO")  # the chains that are timed by size


def frames_of(count: int, width: int, height: int, is_srgb: bool) -> list[np.ndarray]:
    """Return frames of smooth random light, or of its codes."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0, 0.5, (count, -(-height // 40), -(-width // 40), 3))
    light = coarse.repeat(40, 1).repeat(40, 2)[:, :height, :width]
    return list((light * 255).astype(np.uint8) if is_srgb else light.astype(np.float32))


def measure(
    options: dict, rate: float, seconds: float, width: int, height: int
) -> tuple[float, float, float, int]:
    """Return pictures per second, median and largest latency in frames, and dropped frames."""
    frames = frames_of(8, width, height, options.get("transfer") == "srgb")
    sent: dict[int, float] = {}
    late: list[float] = []
    with clpipe.Stream(iso=800, drop=True, **options) as stream:
        stream.warm_up(frames[0].shape, frames[0].dtype)

        def read() -> None:
            for shot in iter(stream.get, None):
                late.append((time.perf_counter() - sent[shot.index]) * rate)

        reader = threading.Thread(target=read)
        reader.start()
        count = int(rate * seconds)
        start = time.perf_counter() + 1
        for number in range(-int(rate), count):  # the first second settles
            time.sleep(max(0.0, start + number / rate - time.perf_counter()))
            sent[number + int(rate)] = time.perf_counter()
            stream.put(frames[number % len(frames)])
            if number == 0:
                began, dropped, done = time.perf_counter(), stream.dropped, len(late)
        stream.end()
        reader.join()
        elapsed = time.perf_counter() - began
        late = late[done:]
        return len(late) / elapsed, float(np.median(late)), max(late), stream.dropped - dropped


def fastest(options: dict, width: int, height: int, seconds: float) -> tuple[float, float]:
    """Return the median time of a call in ms, and the pictures per second of put and get."""
    frames = frames_of(4, width, height, False)
    with clpipe.Stream(iso=800, **options) as stream:
        stream.warm_up(frames[0].shape)
        times = []
        end = time.perf_counter() + seconds / 2
        while time.perf_counter() < end:
            began = time.perf_counter()
            stream(frames[len(times) % 4])
            times.append(time.perf_counter() - began)
    with clpipe.Stream(iso=800, **options) as stream:
        stream.warm_up(frames[0].shape)
        began, count = time.perf_counter(), 0
        stream.put(frames[0])
        while time.perf_counter() < began + seconds / 2:
            stream.put(frames[count % 4])
            stream.get()
            count += 1
        rate = count / (time.perf_counter() - began)
    return 1e3 * float(np.median(times)), rate


def main() -> None:
    """Print a table with a row for each chain, and one with a row for each size."""
    parser = parser_of(__doc__)
    size = (1280, 720)
    parser.add_argument("--size", type=sides_of, default=size, help="the size of frames in px")
    parser.add_argument("--rate", type=float, default=30, help="frames per second")
    parser.add_argument("--seconds", type=float, default=30, help="the time for each chain")
    arguments = parser.parse_args()
    rows = []
    for name, options in CHAINS.items():
        rate, *late, dropped = measure(options, arguments.rate, arguments.seconds, *arguments.size)
        rows.append([name, f"{rate:.1f}", *(f"{each:.2f}" for each in late), dropped])
    heads = ["chain", "pictures per second", "latency in frames, median", "largest", "dropped"]
    print(markdown(heads, rows))
    rows = []
    for width, height in SIZES:
        found = [fastest(CHAINS[name], width, height, arguments.seconds / 5) for name in FAST]
        rows.append(
            [f"{width}x{height}", *(f"{float(f'{each:.3g}'):g}" for pair in found for each in pair)]
        )
    columns = [f"{name}: {what}" for name in FAST for what in ("call, ms", "pictures per second")]
    print(markdown(["size", *columns], rows))


if __name__ == "__main__":
    main()
