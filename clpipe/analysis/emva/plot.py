"""Draws a series: the standard's curves, spectrograms and histograms."""

from collections.abc import Callable
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from scipy.ndimage import uniform_filter

from clpipe.analysis.drawing import finish, page, png_of
from clpipe.analysis.emva.figures import Figures
from clpipe.analysis.emva.moments import Moments
from clpipe.base.types import Doubles

MEASURED, MODEL, OTHER, LIMIT = "#1f5fbf", "#222222", "#c8102e", "#8a8a8a"
BOX = 5  # px; the window of the mean that is subtracted before the histogram of PRNU
BINS = 256


def emva_png(moments: Moments, figures: Figures, title: str) -> bytes:
    """Return the standard's plots as a PNG, 1600 px wide.

    They are sensitivity, photon transfer, signal-to-noise ratio, linearity,
    spectrograms of rows and of columns, and histograms of DSNU and PRNU.
    """
    figure = page(20, title)
    panels: tuple[Callable[[Axes, Moments, Figures], None], ...] = (
        _sensitivity,
        _photon_transfer,
        _signal_to_noise,
        _linearity,
        partial(_spectra, across=False),
        partial(_spectra, across=True),
        _dsnu,
        _prnu,
    )
    for panel, each in zip(figure.subplots(4, 2).ravel(), panels, strict=True):
        each(panel, moments, figures)
        finish(panel)
    return png_of(figure)


def _fitted(panel: Axes, x: Doubles, y: Doubles, figures: Figures, at: float) -> None:
    """Draw points (hollow if they were not fitted) and the saturation."""
    used = figures.fitted
    panel.plot(x[used], y[used], "o", ms=4, color=MEASURED, label="fitted")
    panel.plot(x[~used], y[~used], "o", ms=4, mfc="none", color=MEASURED, label="not fitted")
    panel.axvline(at, color=LIMIT, lw=1, ls=":", label="saturation")


def _sensitivity(panel: Axes, moments: Moments, figures: Figures) -> None:
    photons = moments.bright.photons
    _fitted(panel, photons, moments.light, figures, figures.saturation.value)
    ends = np.array([0, figures.saturation.value])
    slope = figures.responsivity.value
    panel.plot(ends, slope * ends, color=MODEL, lw=1.2, label=f"R = {slope:.4g} DN per photon")
    panel.set(
        title="Sensitivity",
        xlabel="photons per pixel",
        ylabel="mean above dark, DN",
        xlim=(0, None),
    )


def _photon_transfer(panel: Axes, moments: Moments, figures: Figures) -> None:
    light, end = moments.light, float(moments.light[figures.saturated])
    _fitted(panel, light, moments.noise, figures, end)
    slope = figures.system_gain.value
    panel.plot([0, end], [0, slope * end], color=MODEL, lw=1.2, label=f"K = {slope:.4g} DN/e⁻")
    panel.set(
        title="Photon transfer",
        xlabel="mean above dark, DN",
        ylabel="variance above dark, DN²",
        xlim=(0, None),
        ylim=(0, None),
    )


def _signal_to_noise(panel: Axes, moments: Moments, figures: Figures) -> None:
    """Draw SNR over photons with its model, and with DSNU and PRNU."""
    bright = moments.bright
    seen = (bright.variance > 0) & (moments.light > 0)
    seen &= bright.photons <= figures.saturation.value
    panel.plot(
        bright.photons[seen],
        moments.light[seen] / np.sqrt(bright.variance[seen]),
        "o",
        ms=4,
        color=MEASURED,
        label="measured, over time",
    )
    photons = np.geomspace(figures.threshold.value / 2, figures.saturation.value, 200)
    electrons = figures.quantum_efficiency.value * photons
    dark2 = (figures.dark_noise_dn.value / figures.system_gain.value) ** 2
    uneven = figures.dsnu.total.value**2 + (figures.prnu.total.value * electrons) ** 2
    panel.plot(
        photons,
        electrons / np.sqrt(dark2 + electrons),
        color=MODEL,
        lw=1.2,
        label=f"model; at most {figures.snr_max.value:.4g}",
    )
    panel.plot(
        photons,
        electrons / np.sqrt(dark2 + electrons + uneven),
        color=OTHER,
        lw=1.2,
        label="with DSNU and PRNU",
    )
    panel.plot(photons, np.sqrt(photons), color=LIMIT, lw=1, ls="--", label="ideal sensor")
    for end in (figures.threshold.value, figures.saturation.value):
        panel.axvline(end, color=LIMIT, lw=1, ls=":")
    panel.set(
        xscale="log",
        yscale="log",
        title=f"Signal-to-noise ratio; dynamic range {figures.dynamic_range.value:.4g}",
        xlabel="photons per pixel",
        ylabel="SNR",
        xlim=(photons[0], 2 * photons[-1]),
        ylim=(0.3, 2 * photons[-1] ** 0.5),
    )


def _linearity(panel: Axes, moments: Moments, figures: Figures) -> None:
    linearity = figures.linearity
    used = linearity.used
    panel.plot(
        moments.bright.photons[used],
        linearity.deviation[used],
        "-o",
        ms=4,
        lw=1,
        color=MEASURED,
        label=f"{linearity.least.value:+.3g} to {linearity.most.value:+.3g} %",
    )
    panel.axhline(0, color=MODEL, lw=1.2)
    panel.set(title="Linearity", xlabel="photons per pixel", ylabel="off the line, %")


def _spectra(panel: Axes, moments: Moments, figures: Figures, across: bool) -> None:
    """Draw the roots of the mean power spectra of lines, both in e-."""
    gain = figures.system_gain.value
    lit = moments.bright_stack.mean_frame - moments.dark_stack.mean_frame
    unlit = moments.dark_stack
    bright = moments.bright_stack.residue + unlit.residue
    frames = (
        (lit, bright, OTHER, f"with light ({100 * figures.prnu.total.value:.3g} % PRNU)"),
        (unlit.mean_frame, unlit.residue, MEASURED, "dark"),
    )
    for frame, residue, colour, name in frames:
        own = spectrum(frame.T if across else frame) / gain
        panel.plot(np.linspace(0, 0.5, len(own)), own, color=colour, lw=1, label=name)
        panel.axhline(residue**0.5 / gain, color=colour, lw=1, ls=":", label="temporal noise left")
    title = f"Spectrogram along {'columns' if across else 'rows'}"
    panel.set(title=title, yscale="log", xlabel="cycles per pixel", ylabel="deviation, e⁻")


def spectrum(frame: Doubles) -> Doubles:
    """Return the root of the mean power spectrum of a frame's rows.

    For white noise, it is the standard deviation at all frequencies.

    >>> noise = np.random.default_rng(0).normal(0, 3, (500, 64))
    >>> bool(abs(spectrum(noise)[1:] - 3).max() < 0.3)
    True
    """
    waves = np.fft.rfft(frame - frame.mean(), axis=1)
    power = np.square(np.abs(waves)).mean(axis=0) / frame.shape[1]
    return np.asarray(np.sqrt(power))


def _dsnu(panel: Axes, moments: Moments, figures: Figures) -> None:
    frame = moments.dark_stack.mean_frame
    _histogram(panel, (frame - frame.mean()) / figures.system_gain.value)
    panel.set(
        title=f"DSNU, {figures.dsnu.total.value:.3g} e⁻",
        xlabel="off the mean, e⁻ (temporal noise that is left included)",
    )


def _prnu(panel: Axes, moments: Moments, figures: Figures) -> None:
    frame = moments.bright_stack.mean_frame - moments.dark_stack.mean_frame
    detail = frame - uniform_filter(frame, BOX, mode="mirror")
    _histogram(panel, 100 * detail / frame.mean())
    panel.set(
        title=f"PRNU, {100 * figures.prnu.total.value:.3g} % without the filter",
        xlabel=f"off the mean of {BOX}x{BOX} pixels, % (temporal noise that is left included)",
    )


def _histogram(panel: Axes, values: Doubles) -> None:
    """Draw a histogram of pixels, and a Gaussian of the same deviation."""
    counts, edges = np.histogram(values, BINS)
    centres, step = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    sigma = float(values.std())
    panel.stairs(counts, edges, color=MEASURED, fill=True, alpha=0.6, label="pixels")
    if sigma:
        gaussian = np.exp(-np.square(centres / sigma) / 2) / (sigma * np.sqrt(2 * np.pi))
        panel.plot(centres, gaussian * step * values.size, color=MODEL, lw=1.2, label="Gaussian")
    panel.set(yscale="log", ylim=(0.5, None), ylabel="pixels")
