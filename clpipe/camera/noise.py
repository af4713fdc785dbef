"""The three parametrisations of a sensor's noise, and the conversions between them.

- Signal: Var[y] = a*y + b, with y = 0 at the black level and y = 1 at the white level (Foi et al.,
  IEEE TIP 2008, eq. 2).
- EMVA 1288: the system gain in DN/e-, noise before the gain in e-, noise after it in DN.
- "The paper", here and elsewhere in clpipe, has chi, theta, b', b'' and p0. It is Bielova, Haensch,
  Ley, Hellwich, "A Digital Image Processing Pipeline for Modelling of Realistic Noise in Synthetic
  Images", CVPR Workshops 2019.
"""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Emva:
    """EMVA 1288 (release 4.0, 2021, sec. 2): the system gain and the noise without light."""

    system_gain: float  # DN/e-
    read_noise: float  # e-, before the gain
    adc_noise: float = 0.0  # DN, after the gain; rounding to whole DN is not included

    def signal(self, signal_range: float) -> tuple[float, float]:
        """Return a and b in signal units, for a white level ``signal_range`` DN above black.

        a = K / range and b = ((K * read_noise)^2 + adc_noise^2) / range^2, with K the system gain.

        >>> Emva(2.0, 3.0).signal(1000)
        (0.002, 3.6e-05)
        """
        before = (self.system_gain * self.read_noise) ** 2
        return self.system_gain / signal_range, (before + self.adc_noise**2) / signal_range**2


@dataclass(frozen=True)
class Paper:
    """The paper's parameters (Bielova et al. 2019, after Foi et al. 2008, eq. 4 to 8).

    The number of photo-electrons that gives y = 1 at theta = 1 is chi, and theta is the analogue
    gain. The variances of the noise before and after the gain are b' and b'', in signal units
    squared. The pedestal p0 is in signal units.
    """

    chi: float
    theta: float
    b_before: float
    b_after: float
    p0: float = 0.0

    def signal(self) -> tuple[float, float]:
        """Return a = theta/chi and b = theta^2 b' + b'' - theta^2 p0/chi.

        >>> Paper(chi=1024, theta=2, b_before=0.25, b_after=0.125, p0=128).signal()
        (0.001953125, 0.625)
        """
        theta2 = self.theta**2
        return (
            self.theta / self.chi,
            theta2 * self.b_before + self.b_after - theta2 * self.p0 / self.chi,
        )


@dataclass(frozen=True)
class NoiseModel:
    """The strength of shot and read noise, convertible to all three parametrisations.

    ``a`` is in signal units and ``b`` in their square. ``signal_range`` is the white level minus
    the black level in DN. The part of b that arises after the gain is ``after``. The analogue gain
    relative to the camera's lowest is ``theta``. Neither follows from a and b. The defaults put all
    of b before the gain and set theta to 1.

    >>> noise = NoiseModel(a=0.002, b=3.6e-05, signal_range=1000)  # Var[y] = a*y + b
    >>> noise.emva()
    Emva(system_gain=2.0, read_noise=3.0, adc_noise=0.0)
    """

    a: float
    b: float
    signal_range: float
    after: float = 0.0
    theta: float = 1.0

    def emva(self) -> Emva | None:
        """Return the EMVA 1288 parameters; None for a = 0, where the gain would be 0 DN/e-.

        >>> NoiseModel(0.002, 3.6e-5, 1000).emva()
        Emva(system_gain=2.0, read_noise=3.0, adc_noise=0.0)
        """
        if self.a == 0:
            return None
        gain = self.a * self.signal_range
        read_noise = round(max(self.b - self.after, 0.0) ** 0.5 / self.a, 12)
        return Emva(gain, read_noise, self.after**0.5 * self.signal_range)

    def paper(self) -> Paper | None:
        """Return the paper's parameters, with p0 = 0; None for a = 0, where chi would be infinite.

        >>> NoiseModel(0.125, 0.75, 1000, after=0.25, theta=2).paper()
        Paper(chi=16.0, theta=2, b_before=0.125, b_after=0.25, p0=0.0)
        """
        if self.a == 0:
            return None
        before = max(self.b - self.after, 0.0) / self.theta**2
        return Paper(self.theta / self.a, self.theta, before, self.after)

    def record(self) -> dict[str, Any]:
        """Return all three parametrisations as JSON values, for the sidecar."""
        emva, paper = self.emva(), self.paper()
        return {
            "signal": {"a": self.a, "b": self.b},
            "emva1288": asdict(emva) if emva else None,
            "paper": asdict(paper) if paper else None,
        }
