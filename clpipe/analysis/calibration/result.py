"""The result of a calibration at one ISO, and its JSON form."""

from dataclasses import dataclass
from typing import Any

from clpipe.analysis.calibration.dark_current import DarkCurrent
from clpipe.analysis.calibration.dark_figures import DarkFigures
from clpipe.analysis.calibration.fixed_pattern import Pixels
from clpipe.analysis.calibration.line_fit import Bin, Estimate, Line
from clpipe.analysis.calibration.repeats import Sensor
from clpipe.analysis.report import json_object


@dataclass(frozen=True)
class Calibration:
    """The noise at one ISO, in DN unless a comment says otherwise; None if not measurable.

    ``lines`` has a line for each channel, and ``pooled`` is that of all channels together. The
    variance of rounding to whole DN is subtracted from them, but not from ``bins``.
    """

    iso: float
    sensor: Sensor
    scene_frames: int
    dark_frames: int
    lines: dict[str, Line]
    pooled: Line
    bins: dict[str, tuple[Bin, ...]]
    size: int  # pixels of a frame
    used: float  # the share of valid pixels
    rounding: float  # the variance of rounding to whole DN, DN^2
    row_noise: Estimate | None = None
    column_noise: Estimate | None = None
    dsnu: Estimate | None = None
    prnu: Estimate | None = None  # relative
    hot: Pixels | None = None
    dead: Pixels | None = None
    dark: DarkFigures | None = None
    dark_current: DarkCurrent | None = None
    notes: tuple[str, ...] = ()

    @property
    def method(self) -> str:
        """The method by which a and b were estimated, as text."""
        if self.scene_frames > 1:
            return "variance over repeated frames"
        return "single image (Foi et al. 2008)"

    @property
    def read_noise(self) -> Estimate:
        """The read noise in DN; 0 if b is not above zero."""
        return self.pooled.floor.root()

    def record(self) -> dict[str, Any]:
        """Return the calibration as JSON values."""
        unit, gain = self.sensor.unit, self.pooled.gain.value
        return json_object(
            iso=self.iso,
            method=self.method,
            scene_frames=self.scene_frames,
            dark_frames=self.dark_frames,
            share_used=self.used,
            pooled=self.pooled.record(unit),
            channels={name: line.record(unit) for name, line in self.lines.items()},
            row_noise_dn=self.row_noise,
            column_noise_dn=self.column_noise,
            dsnu_e=self.dsnu and self.dsnu.scaled(1 / gain),
            prnu=self.prnu,
            hot_pixels=self.hot and self.hot.record(),
            dead_pixels=self.dead and self.dead.record(),
            dark=self.dark and self.dark.record(),
            dark_current=self.dark_current and self.dark_current.record(),
            notes=self.notes,
        )
