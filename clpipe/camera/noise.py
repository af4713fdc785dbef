"""Three ways to say how strong a sensor's noise is, and how they follow from each other.

Signal: Var[y] = a*y + b, y = 1 at the white level (Foi et al., IEEE TIP 2008, eq. 2). EMVA 1288:
system gain in DN/e-, noise before the gain in e-, noise after it in DN. The paper (Bielova et al.,
CVPR Workshops 2019): chi, theta, b', b'' and p0.
"""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Emva:
    """EMVA 1288 (release 4.0, 2021, sec. 2): what an electron is worth, and the dark noise."""

    system_gain: float  # DN/e-
    read_noise: float  # e-, before the gain
    adc_noise: float = 0.0  # DN, after the gain; the rounding to whole DN is not part of it

    def signal(self, signal_range: float) -> tuple[float, float]:
        """The a and b of this, for a white level that lies ``signal_range`` DN above black.

        >>> Emva(2.0, 3.0).signal(1000)
        (0.002, 3.6e-05)
        """
        before = (self.system_gain * self.read_noise) ** 2
        return self.system_gain / signal_range, (before + self.adc_noise**2) / signal_range**2


@dataclass(frozen=True)
class Paper:
    """Bielova et al. 2019, after Foi et al. 2008, eq. 4 to 8.

    chi is the number of photo-electrons that make y = 1 at theta = 1, theta the analogue gain, b'
    the variance before the gain and b'' after it (signal squared), p0 the pedestal (signal).
    """

    chi: float
    theta: float
    b_before: float
    b_after: float
    p0: float = 0.0

    def signal(self) -> tuple[float, float]:
        """a = theta/chi and b = theta^2 b' + b'' - theta^2 p0/chi.

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
    """How strong shot and read noise are, in all three ways.

    ``signal_range`` is the white level above black in DN. ``after`` is the part of b that arises
    after the gain, ``theta`` the analogue gain over the one that is called 1; neither can be told
    from a and b, so where nothing is known of them all of b arises before, at theta = 1.
    """

    a: float
    b: float
    signal_range: float
    after: float = 0.0
    theta: float = 1.0

    def emva(self) -> Emva | None:
        """The same by EMVA 1288; None without shot noise, where an electron is worth nothing.

        >>> NoiseModel(0.002, 3.6e-5, 1000).emva()
        Emva(system_gain=2.0, read_noise=3.0, adc_noise=0.0)
        """
        if self.a == 0:
            return None
        gain = self.a * self.signal_range
        read_noise = round(max(self.b - self.after, 0.0) ** 0.5 / self.a, 12)
        return Emva(gain, read_noise, self.after**0.5 * self.signal_range)

    def paper(self) -> Paper | None:
        """The same in the paper's parameters, with p0 = 0; None without shot noise.

        >>> NoiseModel(0.125, 0.75, 1000, after=0.25, theta=2).paper()
        Paper(chi=16.0, theta=2, b_before=0.125, b_after=0.25, p0=0.0)
        """
        if self.a == 0:
            return None
        before = max(self.b - self.after, 0.0) / self.theta**2
        return Paper(self.theta / self.a, self.theta, before, self.after)

    def record(self) -> dict[str, Any]:
        """All three as JSON values."""
        emva, paper = self.emva(), self.paper()
        return {
            "signal": {"a": self.a, "b": self.b},
            "emva1288": asdict(emva) if emva else None,
            "paper": asdict(paper) if paper else None,
        }
