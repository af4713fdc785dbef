"""Measures a sensor according to EMVA 1288 from a series, and writes a profile and a picture."""

from pathlib import Path

from clpipe.analysis.calibration.files import write_with_picture
from clpipe.analysis.emva.figures import Figures, figures
from clpipe.analysis.emva.moments import Moments, read_moments
from clpipe.analysis.emva.profile import emva_profile
from clpipe.analysis.emva.series import read_series
from clpipe.base.errors import RequestError
from clpipe.base.extras import require

DEFAULT_ISO = 100.0  # ISO of a profile if you do not state one


def measure_series(path: Path) -> tuple[Moments, Figures]:
    """Return the moments and the figures of a series.

    Args:
        path: the text of the series.

    Raises:
        RequestError: the text or a frame cannot be read or does not fit, the series does not allow
            an estimate, or SciPy or matplotlib is not installed.
    """
    require("clpipe calibrate", "calibrate")
    moments = read_moments(read_series(path))
    try:
        return moments, figures(moments)
    except RequestError as error:
        raise RequestError(f"{path}: {error}") from None


def write_emva_profile(
    path: Path, series: Path, iso: float | None, moments: Moments, found: Figures
) -> Path:
    """Write the profile of a series, and its picture next to it; return the picture's path.

    Args:
        path: the path of the profile.
        series: the path of the text of the series.
        iso: the ISO in the profile for the setting of the series; None is 100.
        moments: the moments of the series.
        found: its figures.

    Raises:
        ImageError: a file cannot be written, or the figures do not form a valid profile.
    """
    from clpipe.analysis.emva.plot import emva_png  # imports Matplotlib

    source = series.absolute().parent.name
    text = emva_profile(path.stem, iso or DEFAULT_ISO, source, moments, found)
    return write_with_picture(path, text, emva_png(moments, found, f"EMVA 1288: {source}"))
