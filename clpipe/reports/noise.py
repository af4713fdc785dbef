"""The noise of images, measured against their truth and compared with the noise model."""

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.analysis.intensity import VarianceLaw
from clpipe.analysis.measure import measure
from clpipe.analysis.pictures import WHOLE, load_picture
from clpipe.analysis.report import NoiseReport
from clpipe.analysis.statistics import Channel
from clpipe.analysis.svg import law_svg, noise_svg
from clpipe.base.errors import ClpipeError
from clpipe.chain.rendition import DEVELOPMENT, MOSAIC
from clpipe.reports.figures import number
from clpipe.reports.run import Blob, Made, Run
from clpipe.reports.shown import checked, picture_file

JUDGED = 12  # raws that are compared with the noise model
LIMIT = 5.0  # standard errors
NORMALIZED = "normalize.exr"  # the mosaic in signal units


@dataclass(frozen=True)
class Law:
    """The variance a y + b of one raw, as measured and from the noise model."""

    name: str
    measured: VarianceLaw
    asked_a: float
    asked_b: float
    report: NoiseReport

    @property
    def errors(self) -> float:
        """The larger deviation of a and b, in standard errors."""
        return max(
            abs(self.measured.a - self.asked_a) / max(self.measured.a_error, 1e-30),
            abs(self.measured.b - self.asked_b) / max(self.measured.b_error, 1e-30),
        )

    @property
    def svg(self) -> str:
        """A plot of the variance of the raw."""
        title = f"Variance by intensity of {self.name}, and the noise model"
        return law_svg(self.report, self.asked_a, self.asked_b, title)

    @property
    def leaves(self) -> bool:
        """Whether the raw deviates from the model."""
        return self.errors > LIMIT


@dataclass(frozen=True)
class Noise:
    """The measured noise of one picture, with a plot."""

    name: str
    against: str
    iso: float
    report: NoiseReport
    svg: str

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The noise of each channel by name."""
        return {one.name: one for one in self.report.channels}


def measured(files: Sequence[Blob]) -> NoiseReport:
    """Measure the noise of the first file against the second.

    Raises:
        ClpipeError: the files cannot be read or compared.
    """
    with ExitStack() as stack:
        paths = []
        for blob in files:
            data = checked(blob)
            ending = Path(blob.name).suffix
            file = stack.enter_context(tempfile.NamedTemporaryFile(suffix=ending))
            file.write(data)
            file.flush()
            paths.append(Path(file.name))
        picture, truth = (load_picture(path) for path in paths)
        return measure([picture], truth)


def noises(run: Run, pictures: Sequence[Made], problems: list[str], most: int) -> list[Noise]:
    """Measure the noise of pictures against their development truth.

    Args:
        run: the run of the pictures.
        pictures: the first ones with a truth are measured.
        problems: gets the errors of measurements.
        most: the number of pictures to measure.
    """
    found: list[Noise] = []
    for made in pictures:
        truth = run.of_image(made.image).get(made.rendition.with_role(DEVELOPMENT))
        pair = picture_file(made), truth and picture_file(truth)
        if len(found) == most or not pair[0] or not pair[1]:
            continue
        try:
            report = measured([pair[0], pair[1]])
        except ClpipeError as error:
            problems.append(f"{made.name}: its noise cannot be measured: {error}")
            continue
        iso = number(made.value("iso"))
        found.append(Noise(made.name, pair[1].name, iso, report, noise_svg(report)))
    return found


def laws(run: Run, problems: list[str]) -> list[Law]:
    """Compare raws with the noise model. Needs kept mosaics after normalize, and their truth.

    The fit is over all four CFA sites together, like in ``clpipe measure``.
    """
    found = []
    pictures = [made for made in run.pictures if NORMALIZED in made.files]
    step = max(len(pictures) // JUDGED, 1)
    for made in pictures[::step][:JUDGED]:
        truth = run.of_image(made.image).get(made.rendition.with_role(MOSAIC))
        asked = made.value("noise", "signal")
        is_known = truth and "exr" in truth.files and isinstance(asked, dict)
        if not truth or not is_known or parameters_of(made, "prnu").get("sigma"):
            continue  # with PRNU the variance is not linear in the intensity
        try:
            report = measured([made.files[NORMALIZED], truth.files["exr"]])
        except ClpipeError as error:
            problems.append(f"{made.name}: its raw cannot be measured: {error}")
            continue
        fit = next(one.law for one in report.channels if one.name == WHOLE)
        if not fit:
            continue
        asked_a, asked_b = number(asked.get("a")), number(asked.get("b")) + other_noise(made)
        found.append(Law(made.name, fit, asked_a, asked_b, report))
    return found


def parameters_of(made: Made, step: str) -> Mapping[str, Any]:
    """Return the parameters of a step of a picture's chain. Empty without the step."""
    for each in made.steps:
        if each.get("name") == step:
            parameters = each.get("parameters")
            return parameters if isinstance(parameters, dict) else {}
    return {}


def other_noise(made: Made) -> float:
    """Return the variance of a mosaic besides shot and read noise, in squared signal.

    It contains row noise, column noise, DSNU and rounding to DN. Rounding adds 1/12 DN² twice,
    because the truth is rounded as well.
    """
    lines = ("row_noise", "column_noise", "dsnu")
    variance = sum(number(parameters_of(made, step).get("sigma")) ** 2 for step in lines)
    digital = parameters_of(made, "quantize")
    step = number(digital.get("white_level")) - number(digital.get("black_level"))
    return variance + (2 / (12 * step**2) if step > 0 else 0.0)
