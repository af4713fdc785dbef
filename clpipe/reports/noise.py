"""The noise of images, measured against their truth and compared with the noise model."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clpipe.analysis.finished import finished_rows
from clpipe.analysis.intensity import VarianceLaw
from clpipe.analysis.measure import measure
from clpipe.analysis.pictures import WHOLE, load_picture
from clpipe.analysis.plot import law_svg, noise_svg
from clpipe.analysis.report import NoiseReport
from clpipe.analysis.statistics import Channel
from clpipe.base.errors import ClpipeError
from clpipe.chain.registry import all_stages, stage_in
from clpipe.chain.rendition import DEVELOPMENT, MOSAIC
from clpipe.reports.figures import number
from clpipe.reports.images import checked, picture_file
from clpipe.reports.run import Blob, Run, RunPicture
from clpipe.stage import StageRole

MAX_LAWS = 12  # raws that are compared with the noise model
LIMIT = 5.0  # standard errors; a larger deviation from the model is reported
NORMALIZED = "normalize.exr"  # the mosaic in signal units


@dataclass(frozen=True)
class Law:
    """The variance a y + b of one raw, as measured and from the noise model."""

    name: str
    measured: VarianceLaw
    requested_a: float
    requested_b: float
    report: NoiseReport

    @property
    def errors(self) -> float:
        """The larger deviation of a and b, in standard errors."""
        return max(
            abs(self.measured.a - self.requested_a) / max(self.measured.a_error, 1e-30),
            abs(self.measured.b - self.requested_b) / max(self.measured.b_error, 1e-30),
        )

    @property
    def svg(self) -> str:
        """A plot of the variance of the raw."""
        title = f"Variance by intensity of {self.name}, and the noise model"
        return law_svg(self.report, self.requested_a, self.requested_b, title)

    @property
    def deviates(self) -> bool:
        """Whether the raw deviates from the model."""
        return self.errors > LIMIT


@dataclass(frozen=True)
class Noise:
    """The measured noise of one picture, with a plot."""

    name: str
    reference: str
    iso: float
    report: NoiseReport
    svg: str

    @property
    def finished(self) -> list[tuple[str, float, str]]:
        """The noise by luma: texts, figures, and the ranges of real cameras."""
        return finished_rows(self.report.finished)

    @property
    def channels(self) -> Mapping[str, Channel]:
        """The noise of each channel by name."""
        return {one.name: one for one in self.report.channels}


def measured(files: Sequence[Blob]) -> NoiseReport:
    """Measure the noise of the first file against the second.

    Raises:
        ClpipeError: the files cannot be read or compared.
    """
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, f"{k}{Path(blob.name).suffix}") for k, blob in enumerate(files)]
        for path, blob in zip(paths, files, strict=True):
            path.write_bytes(checked(blob))
        picture, truth = map(load_picture, paths)
        return measure([picture], truth)


def noises(run: Run, pictures: Sequence[RunPicture], problems: list[str], most: int) -> list[Noise]:
    """Measure the noise of pictures against their development truth.

    Args:
        run: the run of the pictures.
        pictures: the first ones with a truth are measured.
        problems: gets the errors of measurements.
        most: the number of pictures to measure.
    """
    found: list[Noise] = []
    for picture in pictures:
        truth = run.of_image(picture.image).get(picture.rendition.with_role(DEVELOPMENT))
        pair = picture_file(picture), truth and picture_file(truth)
        if len(found) == most or not pair[0] or not pair[1]:
            continue
        try:
            report = measured([pair[0], pair[1]])
        except ClpipeError as error:
            problems.append(f"{picture.name}: its noise cannot be measured: {error}")
            continue
        iso = number(picture.value("iso"))
        found.append(Noise(picture.name, pair[1].name, iso, report, noise_svg(report)))
    return found


def laws(run: Run, problems: list[str]) -> list[Law]:
    """Compare raws with the noise model. Needs kept mosaics after normalize, and their truth.

    The fit is over all four CFA sites together, like in ``clpipe measure``.
    """
    found = []
    pictures = [picture for picture in run.pictures if NORMALIZED in picture.files]
    step = max(len(pictures) // MAX_LAWS, 1)
    for picture in pictures[::step][:MAX_LAWS]:
        truth = run.of_image(picture.image).get(picture.rendition.with_role(MOSAIC))
        requested = picture.value("noise", "signal")
        is_known = truth and "exr" in truth.files and isinstance(requested, dict)
        if not truth or not is_known or parameters_of(picture, "prnu").get("sigma"):
            continue  # with PRNU the variance is not linear in the intensity
        try:
            report = measured([picture.files[NORMALIZED], truth.files["exr"]])
        except ClpipeError as error:
            problems.append(f"{picture.name}: its raw cannot be measured: {error}")
            continue
        fit = next(one.law for one in report.channels if one.name == WHOLE)
        if not fit:
            continue
        a, b = number(requested.get("a")), number(requested.get("b")) + other_noise(picture)
        found.append(Law(picture.name, fit, a, b, report))
    return found


def parameters_of(picture: RunPicture, step: str) -> Mapping[str, Any]:
    """Return the parameters of a step of a picture's chain. Empty without the step."""
    for each in picture.steps:
        if each.get("name") == step:
            parameters = each.get("parameters")
            return parameters if isinstance(parameters, dict) else {}
    return {}


def other_noise(picture: RunPicture) -> float:
    """Return the variance of a mosaic besides shot and read noise, in squared signal.

    It contains row noise, column noise, DSNU and rounding to DN. Rounding adds 1/12 DN² twice,
    because the truth is rounded as well.
    """
    lines = [s.name for s in all_stages().values() if s.role is StageRole.SENSOR_OFFSETS]
    variance = sum(number(parameters_of(picture, step).get("sigma")) ** 2 for step in lines)
    digital = parameters_of(picture, stage_in(StageRole.RAW).name)
    step = number(digital.get("white_level")) - number(digital.get("black_level"))
    return variance + (2 / (12 * step**2) if step > 0 else 0.0)
