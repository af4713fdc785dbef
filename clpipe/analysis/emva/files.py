"""A sensor measured after EMVA 1288, from files: a series in, a profile and its picture out."""

from pathlib import Path

from clpipe.analysis.calibration.files import write_with_picture
from clpipe.analysis.emva.figures import Figures, figures
from clpipe.analysis.emva.moments import Moments, read_moments
from clpipe.analysis.emva.profile import emva_profile
from clpipe.analysis.emva.series import read_series
from clpipe.base.errors import RequestError
from clpipe.base.extras import require

USUAL_ISO = 100.0  # of a profile, where the user states none


def measure_series(path: Path) -> tuple[Moments, Figures]:
    """The moments and the figures of a series.

    Args:
        path: of its text.

    Raises:
        RequestError: the text or a frame cannot be read or does not fit, or the series does not
            allow an estimate; SciPy or matplotlib is not installed.
    """
    require("clpipe calibrate", "scipy", "matplotlib")
    moments = read_moments(read_series(path))
    try:
        return moments, figures(moments)
    except RequestError as error:
        raise RequestError(f"{path}: {error}") from None


def write_emva_profile(
    path: Path, series: Path, iso: float | None, moments: Moments, found: Figures
) -> Path:
    """Write the profile of a series, and its picture beside it; returns the picture's path.

    Args:
        path: of the profile.
        series: the path of the text of the series.
        iso: what the profile calls the setting of the series; None is 100.
        moments: of the series.
        found: its figures.

    Raises:
        ImageError: a file cannot be written, or the figures make no valid profile.
    """
    from clpipe.analysis.emva.plot import emva_png  # imports Matplotlib

    source = series.absolute().parent.name
    text = emva_profile(path.stem, iso or USUAL_ISO, source, moments, found)
    return write_with_picture(path, text, emva_png(moments, found, f"EMVA 1288: {source}"))
