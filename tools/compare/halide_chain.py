"""A development chain in Halide, for the comparison in halide.py.

It develops a Bayer raw of 16-bit integers into an 8-bit picture, with the parameters of clpipe's
own chain. Like the camera pipelines of phones, it computes in integers:

- normalize, white_balance: one gain for each colour of the pattern, to 14 bits above black.
- demosaic: the linear filters of Malvar, He and Cutler (2004), in 32 bits.
- color_matrix: 12 fractional bits.
- sharpen: an unsharp mask on luma with the same weights, amount and limit.
- tone_curve, gamma: one table of 14 bits to 8 bits.

It does less than clpipe:

- Signals below black are clipped before demosaicing, and all signals are rounded to 14 bits.
- Sharpening works on luma, not on its root, and adds to all colours equally.
- The tone curve applies to each colour. clpipe applies it to the largest and keeps the ratios.
- It has no tiles, and only accepts even widths and heights that are multiples of BAND.
"""

from pathlib import Path
from typing import Any

import halide as hl
import numpy as np

from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve

TOP = (1 << 14) - 1
AUTOSCHEDULERS = ("Mullapudi2016", "Adams2019")
BAND = 32  # rows of the hand-written schedule's bands; the fastest of 16, 32, 64 and 128


class HalideChain:
    """The chain with the parameters of a resolved chain of clpipe.

    Args:
        chain: clpipe's chain; it starts on a raw.
        width, height: the size of the raws.
        schedule: "by hand", or the name of one of Halide's autoschedulers.
        cores: the number of cores for which an autoscheduler schedules.
    """

    def __init__(self, chain: Chain, width: int, height: int, schedule: str, cores: int) -> None:
        self._raw = hl.ImageParam(hl.UInt(16), 2, "raw")
        self._parameters = parameters_of(chain)
        self._x, self._y, self._c = hl.Var("x"), hl.Var("y"), hl.Var("c")
        stages = self._algorithm()
        self._out = stages["out"]
        if schedule == "by hand":
            self._schedule(stages)
            self._pipeline = hl.Pipeline(self._out)
        else:
            self._autoschedule(schedule, width, height, cores)
        self._pipeline.compile_jit()

    def __call__(self, raw: Array, into: Array) -> None:
        """Develop a raw, (height, width) uint16, into a picture, (height, width, 3) uint8."""
        self._raw.set(hl.Buffer(raw))
        self._pipeline.realize(hl.Buffer(into))

    def _algorithm(self) -> dict[str, hl.Func]:
        """Return the stages of the chain, by name."""
        x, y, c, of = self._x, self._y, self._c, self._parameters
        i32 = hl.Int(32)

        def clipped(value: Any) -> Any:
            return hl.cast(hl.Int(16), hl.clamp(value, 0, TOP))

        raw = hl.BoundaryConditions.mirror_interior(
            self._raw, [(0, self._raw.width()), (0, self._raw.height())]
        )
        gains, levels = of["gains"], hl.Func("levels")
        gain = hl.select(
            x % 2 == y % 2, hl.select(y % 2 == 0, gains[0], gains[2]), hl.Expr(gains[1])
        )
        levels[x, y] = clipped((hl.cast(i32, raw[x, y]) - of["black"]) * gain >> 12)

        def at(dx: int, dy: int) -> Any:
            return hl.cast(i32, levels[x + dx, y + dy])

        # The filters of the paper, times 16.
        centre = at(0, 0)
        row, column = at(-1, 0) + at(1, 0), at(0, -1) + at(0, 1)
        far_row, far_column = at(-2, 0) + at(2, 0), at(0, -2) + at(0, 2)
        corners = at(-1, -1) + at(1, -1) + at(-1, 1) + at(1, 1)
        green = clipped((4 * (row + column) + 8 * centre - 2 * (far_row + far_column) + 8) >> 4)
        along = clipped((8 * row + 10 * centre - 2 * (corners + far_row) + far_column + 8) >> 4)
        across = clipped((8 * column + 10 * centre - 2 * (corners + far_column) + far_row + 8) >> 4)
        opposite = clipped((4 * corners + 12 * centre - 3 * (far_row + far_column) + 8) >> 4)
        own, even_row, is_green = levels[x, y], y % 2 == 0, x % 2 != y % 2
        colours = hl.Func("colours")
        colours[x, y, c] = hl.mux(
            c,
            [
                hl.select(
                    is_green,
                    hl.select(even_row, along, across),
                    hl.select(even_row, own, opposite),
                ),
                hl.select(is_green, own, green),
                hl.select(
                    is_green,
                    hl.select(even_row, across, along),
                    hl.select(even_row, opposite, own),
                ),
            ],
        )
        matrix, corrected = of["matrix"], hl.Func("corrected")
        rows = [
            clipped(
                sum(int(m) * hl.cast(i32, colours[x, y, k]) for k, m in enumerate(line)) + 2048
                >> 12
            )
            for line in matrix
        ]
        corrected[x, y, c] = hl.mux(c, rows)
        luma = hl.Func("luma")
        shares = zip((77, 150, 29), range(3), strict=True)
        luma[x, y] = hl.cast(
            hl.Int(16), sum(s * hl.cast(i32, corrected[x, y, k]) for s, k in shares) >> 8
        )
        weights = dict(enumerate(of["weights"]))

        def taps(values: Any) -> Any:
            reach = len(weights) - 1
            return sum(weights[abs(k)] * hl.cast(i32, values(k)) for k in range(-reach, reach + 1))

        smooth_rows, smooth = hl.Func("smooth_rows"), hl.Func("smooth")
        smooth_rows[x, y] = hl.cast(hl.Int(16), taps(lambda k: luma[x + k, y]) >> 12)
        smooth[x, y] = hl.cast(hl.Int(16), taps(lambda k: smooth_rows[x, y + k]) >> 12)
        change = hl.Func("change")
        detail = hl.cast(i32, luma[x, y]) - smooth[x, y]
        change[x, y] = hl.cast(
            hl.Int(16), hl.clamp(detail * of["amount"] >> 8, -of["limit"], of["limit"])
        )
        table, out = hl.Buffer(of["table"]), hl.Func("out")
        out[c, x, y] = table[hl.clamp(hl.cast(i32, corrected[x, y, c]) + change[x, y], 0, TOP)]
        return {
            "levels": levels,
            "colours": colours,
            "corrected": corrected,
            "luma": luma,
            "smooth_rows": smooth_rows,
            "change": change,
            "out": out,
        }

    def _schedule(self, stages: dict[str, hl.Func]) -> None:
        """Schedule by hand: bands of rows in parallel, in which pairs of rows slide through."""
        x, y, c = self._x, self._y, self._c
        band, row, pair, of_pair = (hl.Var(name) for name in ("band", "row", "pair", "of_pair"))
        block, of_block = hl.Var("block"), hl.Var("of_block")
        lanes = hl.get_jit_target_from_environment().natural_vector_size(hl.Int(32))
        out = stages["out"]
        out.bound(c, 0, 3).split(y, band, row, BAND, hl.TailStrategy.RoundUp)
        out.split(row, pair, of_pair, 2, hl.TailStrategy.RoundUp)
        out.reorder(c, x, of_pair, pair, band).unroll(c).parallel(band)
        out.vectorize(x, lanes, hl.TailStrategy.GuardWithIf)
        for stage in list(stages.values())[:-1]:
            stage.store_at(out, band).compute_at(out, pair)
        for name in ("levels", "luma", "smooth_rows", "change"):
            stages[name].vectorize(x, lanes)
        stages["levels"].align_bounds(x, 2).align_bounds(y, 2)
        stages["corrected"].bound(c, 0, 3).reorder(c, x, y).unroll(c).vectorize(x, lanes)
        # The parity of a pixel is a constant in its block of 2x2.
        colours = stages["colours"].bound(c, 0, 3).align_bounds(x, 2).align_bounds(y, 2)
        colours.split(x, block, of_block, 2).reorder(c, of_block, block, y)
        colours.unroll(c).unroll(of_block).vectorize(block, lanes).unroll(y, 2)

    def _autoschedule(self, name: str, width: int, height: int, cores: int) -> None:
        """Schedule with one of Halide's autoschedulers."""
        folder = Path(hl.__file__).parent / "lib64"
        hl.load_plugin(str(folder / f"libautoschedule_{name.lower()}.so"))
        self._raw.set_estimates([(0, width), (0, height)])
        self._out.set_estimates([(0, 3), (0, width), (0, height)])
        self._pipeline = hl.Pipeline(self._out)
        target = hl.get_jit_target_from_environment()
        settings = hl.AutoschedulerParams(name, {"parallelism": str(cores)})
        self._pipeline.apply_autoscheduler(target, settings)


def parameters_of(chain: Chain) -> dict[str, Any]:
    """Return the parameters of a chain of clpipe in the integers of the Halide chain."""
    of: dict[str, Any] = {step.name: step.method for step in chain.steps}
    camera = chain.camera
    black, white = camera.black_level, camera.white_level
    balance, sharpen, style = of["white_balance"], of["sharpen"], of["tone_curve"]
    gains = np.array([balance.red_gain, 1.0, balance.blue_gain]) * TOP / (white - black)
    context = {step.name: step.context for step in chain.steps}
    matrix = np.array(list(of["color_matrix"].arguments(context["color_matrix"]).values()), float)
    weights = np.array(sharpen.arguments(context["sharpen"])["weights"], float)
    light = np.arange(TOP + 1) / TOP
    curve = srgb_curve(style.curve(np.float32(light)))
    return {
        "black": int(black),
        "gains": [round(gain * 4096) for gain in gains],
        "matrix": np.rint(matrix.reshape(3, 3) * 4096).astype(int).tolist(),
        "weights": np.rint(weights * 4096).astype(int).tolist(),
        "amount": round(float(sharpen.amount) * 256),
        "limit": round(float(sharpen.limit) * TOP),
        "table": np.ascontiguousarray(to_8_bit(np.float32(curve))),
    }
