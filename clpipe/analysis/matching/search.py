"""The search for a development whose noise has a camera's signature.

Methods are tried part by part (coordinate descent). For each, numbers are fitted by least squares
(SciPy's trust region, with bounds). All evaluations share their random numbers, so that the sum of
squares is a smooth function of the numbers.
"""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from clpipe.analysis.matching.columns import (
    COLUMNS,
    Figures,
    Noise,
    ValidPixels,
    errors_of,
    figures_of,
)
from clpipe.analysis.matching.scenes import Scene, Scenes, crops_of
from clpipe.analysis.matching.simulation import Simulator
from clpipe.analysis.matching.space import (
    DEVELOPMENT,
    RESIZE,
    Choice,
    Dimension,
    Space,
    dimensions_of,
    variants_of,
)
from clpipe.base.types import Doubles, Mask
from clpipe.chain.keys import set_dotted
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.device import Device

LOG = logging.getLogger(__name__)

# Steps of least squares at first, while a candidate is promising, and at the end.
FIRST_STEPS, TRIAL_STEPS, FINAL_STEPS = 2, 3, 20

# Relative tolerances of least squares. The last fit uses the second.
COARSE_TOLERANCE, FINE_TOLERANCE = 1e-3, 1e-4

# Limits of a variant's cost, relative to the best cost. A variant is abandoned if its cost exceeds
# the first limit before any fit, or the second one after FIRST_STEPS.
ABANDON_RATIO, PROMISING_RATIO = 5.0, 1.5

# No other method is tried if the residual of a typical column is below this value.
GOOD_RESIDUAL = 0.5
CONVERGED = 0.95  # the fit ends if a few steps leave more than this share of the cost
DIFFERENCE_STEP = 0.03  # step of finite differences, relative to a dimension's range
LOSS_SCALE = 3.0  # larger residuals count less than their squares (soft L1)
IMPROVEMENT = 0.9  # another method must cost less than this share, because costs are random
# Number of scenes for comparing methods, and the size of their crops in px.
TRIAL_SCENES, TRIAL_CROP = 4, 384
ROUNDS = 2  # number of times that each part is tried
FINAL_FIT_TRIALS = 20  # duration of the last fit (all scenes at full size), in trials


@dataclass(frozen=True)
class Candidate:
    """A development: its settings, the fitted numbers, and the remaining cost.

    ``residual`` is the residual of a typical column, in units of its error and floor together.
    """

    choices: Mapping[str, Choice]
    settings: Settings
    numbers: Mapping[str, float]
    cost: float
    residual: float


class StoppedError(Exception):
    """A search was stopped before its end."""


class Watch:
    """Receives the progress of a search. This base class ignores it, and never stops a search."""

    is_stopping = False  # set to True to make the search raise StoppedError

    def advanced(self, share: float, best: Candidate, scenes: Scenes) -> None:
        """Receive the share of the search that is done, 0 to 1, and the best development so far."""


@dataclass(frozen=True)
class Target:
    """A scene with its target columns and their standard errors."""

    scene: Scene
    places: ValidPixels
    figures: Figures
    errors: Figures

    def residuals(self, ours: Figures) -> Doubles:
        """Return the residuals of comparable columns, in units of error and floor together."""
        found = []
        for name, column in COLUMNS.items():
            theirs, error = self.figures[name], self.errors[name]
            if np.isnan(theirs) or name in self.scene.left_out:
                continue
            difference = column.residual(ours[name], theirs)
            scale = np.hypot(column.floor, abs(column.residual(theirs + error, theirs)))
            found.append(np.nan_to_num(difference, nan=LOSS_SCALE * column.floor) / scale)
        return np.clip(found, -30, 30)


class Search:
    """Searches for the development that reproduces the noise of scenes.

    Args:
        scenes: the camera's pictures.
        settings: the settings to start from.
        space: the choices to compare.
        device: the device for development; None is NumPy.
        watch: receives the progress, and may stop the search.
    """

    def __init__(
        self,
        scenes: Scenes,
        settings: Settings,
        space: Space,
        device: Device | None,
        watch: Watch | None = None,
    ) -> None:
        self.scenes = scenes
        self.watch = watch or Watch()
        self.settings = settings
        self.space = space
        self.simulator = Simulator(device)
        self.targets = [target_of(s, ~s.holdout) for s in scenes.each if s.mask.any()]
        self.evaluations = 0
        self._cache: dict[tuple[str, Scene], Figures] = {}  # figures by settings and scene
        self._trials, self._expected_trials, self._share = 0, FINAL_FIT_TRIALS, 0.0

    def run(self) -> Candidate:
        """Return the best development.

        Raises:
            StoppedError: the watch stopped the search.
        """
        flattest = sorted(self.targets, key=lambda t: -int(t.scene.mask.sum()))[:TRIAL_SCENES]
        crops = [crops_of(target.scene, TRIAL_CROP, 1)[0] for target in flattest]
        trial_targets = [target_of(crop, ~crop.holdout) for crop in crops]
        first = self.fit(self.space.first, {}, trial_targets, TRIAL_STEPS)
        self.watch.advanced(0.0, first, self.scenes)
        best = self.converged(first, trial_targets)
        LOG.info("start: residuals of %.2g", best.residual)
        tried = {labels(best.choices)}
        parts, count = list(self.space.choices) * ROUNDS, len(self.space.choices)
        unchanged = 0  # number of parts tried since the best candidate last changed
        for number, part in enumerate(parts):
            if unchanged == count:
                break
            # If the best candidate changes, more parts follow.
            ahead = parts[number:][: count - unchanged]
            self._expected_trials = (
                self._trials
                + sum(self.variant_count(best, each) for each in ahead)
                + FINAL_FIT_TRIALS
            )
            before = best
            for choice in self.space.choices[part]:
                best = self.report(self.attempt(best, part, choice, trial_targets, tried))
            for step in steps_of(best, part):
                for choice in variants_of(best.settings, step):
                    variant = merge_choices(best.choices[part], choice)
                    best = self.report(
                        self.attempt(best, part, variant, trial_targets, tried, is_variant=True)
                    )
            unchanged = unchanged + 1 if best is before else 1
        last = self.fit(best.choices, best.numbers, self.targets, FINAL_STEPS)
        # Fit again, with a new trust region.
        again = self.fit(last.choices, last.numbers, self.targets, FINAL_STEPS)
        return min(last, again, key=lambda candidate: candidate.cost)

    def variant_count(self, best: Candidate, part: str) -> int:
        """Return the number of choices of a part to try."""
        steps = steps_of(best, part)
        variants = sum(1 for step in steps for _ in variants_of(best.settings, step))
        return len(self.space.choices[part]) + variants

    def report(self, best: Candidate) -> Candidate:
        """Return the best candidate, after reporting it and one more trial to the watch."""
        self._trials += 1
        self._share = max(self._share, min(self._trials / self._expected_trials, 1.0))
        self.watch.advanced(self._share, best, self.scenes)
        return best

    def attempt(
        self,
        best: Candidate,
        part: str,
        choice: Choice,
        targets: Sequence[Target],
        tried: set[tuple[str, ...]],
        is_variant: bool = False,
    ) -> Candidate:
        """Return the better of the best candidate and a variant with another choice of a part.

        The variant's numbers start from the best candidate's. Numbers of the part do so only if
        ``is_variant``, the choice has the same method, because they differ in meaning between
        methods. At another size, all numbers start anew.
        """
        choices = {**best.choices, part: choice}
        other = labels(choices)
        if other in tried or best.residual < GOOD_RESIDUAL:
            return best
        tried.add(other)
        start = {k: v for k, v in best.numbers.items() if is_variant or k.partition(".")[0] != part}
        if part == RESIZE:
            start = {}
        found = self.fit(choices, start, targets, 0)
        if found.cost < ABANDON_RATIO * best.cost:
            found = self.fit(choices, start, targets, FIRST_STEPS)
        found = self.converged(found, targets, PROMISING_RATIO * best.cost)
        LOG.debug("%s: cost %.1f, best %.1f", ", ".join(other), found.cost, best.cost)
        if found.cost >= IMPROVEMENT * best.cost:
            return best
        LOG.info("%s: residuals of %.2g", ", ".join(other), found.residual)
        return found

    def converged(
        self, candidate: Candidate, targets: Sequence[Target], limit: float = np.inf
    ) -> Candidate:
        """Return a candidate, fitted until further steps gain little, or until it cannot win.

        The best candidate is also fitted this far, so that comparisons are fair.
        """
        before = np.inf
        while candidate.cost < min(limit, CONVERGED * before):
            before = candidate.cost
            candidate = self.fit(candidate.choices, candidate.numbers, targets, TRIAL_STEPS)
        return candidate

    def fit(
        self,
        choices: Mapping[str, Choice],
        start: Mapping[str, float],
        targets: Sequence[Target],
        steps: int,
    ) -> Candidate:
        """Return the numbers of a set of choices, fitted from a start that may lack some."""
        from scipy.optimize import least_squares

        settings = self.settings
        for choice in choices.values():
            settings = choice.over(settings)
        dimensions = self.dimensions(settings)
        numbers = {d.name: start.get(d.name, d.start) for d in dimensions}
        numbers = self.scaled(settings, numbers, targets[0])

        def residuals(positions: Doubles) -> Doubles:
            values = {
                d.name: d.value(place - 1) for d, place in zip(dimensions, positions, strict=True)
            }
            return self.residuals(with_numbers(settings, values), targets)

        def made(values: Mapping[str, float], cost: float) -> Candidate:
            is_variant = with_numbers(settings, values)
            return Candidate(choices, is_variant, values, cost, typical_residual(cost, targets))

        # Positions are from 1 to 2, because SciPy's steps for differences are relative and would
        # vanish at 0.
        positions = np.clip([1 + d.share(numbers[d.name]) for d in dimensions], 1.01, 1.99)
        if not (dimensions and steps):
            knee = (residuals(positions) / LOSS_SCALE) ** 2
            cost = float(LOSS_SCALE**2 * (np.sqrt(1 + knee) - 1).sum())  # like SciPy's soft_l1
            return made(numbers, cost)
        tolerance = FINE_TOLERANCE if targets is self.targets else COARSE_TOLERANCE
        found = least_squares(
            residuals,
            positions,
            bounds=(1, 2),
            diff_step=DIFFERENCE_STEP,
            loss="soft_l1",
            f_scale=LOSS_SCALE,
            max_nfev=steps,
            xtol=tolerance,
            ftol=tolerance,
        )
        values = {d.name: d.value(x - 1) for d, x in zip(dimensions, found.x, strict=True)}
        return made(values, float(found.cost))

    def dimensions(self, settings: Settings) -> list[Dimension]:
        """Return the numbers that are searched for some settings."""
        strength = [self.space.strength] if self.space.strength else []
        return [*strength, *dimensions_of(make_chain(settings), self.space.is_toned)]

    def scaled(
        self, settings: Settings, numbers: Mapping[str, float], target: Target
    ) -> dict[str, float]:
        """Return the numbers with a strength that approximates the luma rms of a scene.

        Variance is about proportional to the ISO.
        """
        scaled, strength = dict(numbers), self.space.strength
        for _ in range(2 if strength else 0):
            assert strength
            ours = self.figures(with_numbers(settings, scaled), target)["rms"]
            ratio = target.figures["rms"] / max(ours, 0.1)
            scaled["iso"] = strength.value(strength.share(scaled["iso"] * ratio**2))
        return scaled

    def residuals(self, settings: Settings, targets: Sequence[Target]) -> Doubles:
        """Return the residuals of all columns of some scenes.

        Raises:
            StoppedError: the watch stopped the search.
        """
        if self.watch.is_stopping:
            raise StoppedError
        with ThreadPoolExecutor() as pool:
            figures = pool.map(lambda target: self.figures(settings, target), targets)
            found = [t.residuals(f) for t, f in zip(targets, figures, strict=True)]
        return np.concatenate(found) / len(targets) ** 0.5

    def figures(self, settings: Settings, target: Target) -> Figures:
        """Return the columns of a scene's development, which is cached."""
        key = repr(settings), target.scene
        if key not in self._cache:
            self.evaluations += 1
            noise = self.simulator.noise(settings, target.scene, "search")
            self._cache[key] = figures_of(noise, target.places)
        return self._cache[key]


def target_of(scene: Scene, part: Mask | None = None) -> Target:
    """Return a scene, or a part of it, as a target."""
    return target_at(scene, scene.noise, scene.places(part))


def target_at(scene: Scene, noise: Noise, places: ValidPixels) -> Target:
    """Return a target from noise; columns are NaN if there are too few samples for an error."""
    figures, errors = figures_of(noise, places), errors_of(noise, places)
    kept = {name: np.nan if np.isnan(errors[name]) else figures[name] for name in figures}
    return Target(scene, places, kept, errors)


def typical_residual(cost: float, targets: Sequence[Target]) -> float:
    """Return the residual of a typical column at a cost, in units of error and floor."""
    columns = sum(len(target.residuals(target.figures)) for target in targets) / len(targets)
    return float((2 * cost / columns) ** 0.5)


def labels(choices: Mapping[str, Choice]) -> tuple[str, ...]:
    """Return the names of choices."""
    return tuple(choice.text for choice in choices.values())


def steps_of(candidate: Candidate, part: str) -> list[str]:
    """Return the steps of a part whose structure is searched, including added denoising."""
    own = candidate.choices[part].values
    return [part] if part in DEVELOPMENT else [step for step in own if step.startswith("denoise")]


def merge_choices(first: Choice, second: Choice) -> Choice:
    """Return a choice merged with a variant of it."""
    return Choice(second.text, {**first.values, **second.values}, first.stages)


def with_numbers(settings: Settings, numbers: Mapping[str, float]) -> Settings:
    """Return the settings with numbers set by their dotted names."""
    values: dict[str, Any] = {}
    for name, number in numbers.items():
        set_dotted(values, name, number)
    return overlay(settings, values)
