"""Gain stages: groups of ISOs that share a conversion gain, found from their read noise."""

from collections.abc import Sequence

import numpy as np

from clpipe.analysis.calibration.result import Calibration

# A gain stage ends where the read noise is below this share of the value that the previous stage
# predicts. We chose the value; see test_gain_stages_are_cut_where_the_conversion_gain_changes.
LEAST_OF_PREDICTED = 0.7


def gain_stages(calibrations: Sequence[Calibration]) -> list[list[Calibration]]:
    """Return calibrations in ascending order of ISO, split where the conversion gain changes.

    Within a gain stage, the read noise in DN is sqrt((before * K)^2 + after^2), where K is the
    system gain, so it rises with the ISO. A new stage begins if read noise falls. After two ISOs of
    a stage, it also begins if read noise is less than 0.7 of the prediction from them.
    """
    stages: list[list[Calibration]] = []
    for one in sorted(calibrations, key=lambda c: c.iso):
        if stages and one.read_noise.value >= _least_read_noise(stages[-1], one):
            stages[-1].append(one)
        else:
            stages.append([one])
    return stages


def _least_read_noise(stage: Sequence[Calibration], one: Calibration) -> float:
    """Return the read noise in DN below which an ISO does not belong to a gain stage."""
    last = stage[-1]
    doubt = 2 * float(np.hypot(last.read_noise.error, one.read_noise.error))
    least = last.read_noise.value - doubt
    if len(stage) > 1:
        gain2 = [c.pooled.gain.value**2 for c in (stage[0], last, one)]
        read2 = [c.read_noise.value**2 for c in (stage[0], last)]
        before2 = max((read2[1] - read2[0]) / (gain2[1] - gain2[0]), 0.0)
        predicted = max(read2[1] + before2 * (gain2[2] - gain2[1]), 0.0)
        least = max(least, LEAST_OF_PREDICTED * float(np.sqrt(predicted)) - doubt)
    return least
