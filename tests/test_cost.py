"""Python calls and launches that a sample and an image cost: counts, so they hold on any machine.

They are counted in a process of their own, where no other test has filled a cache. The ceilings are
what was measured when they were last lowered. Lower them with the cost.
"""

import itertools
import json
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
import pyopencl as cl
import pytest

import clpipe
from clpipe.batch.threads import Batch
from clpipe.engine.device import open_devices
from clpipe.images.write import write_exr
from tests.conftest import ROOT, run_python

CAMERAS = ["sony-a7r2", "canon-5d2", "canon-6d", "nikon-d850"]
SLACK = 1.05  # for other versions of Python and of libraries


class Counter:
    """Counts launches, and Python calls in this thread and later ones."""

    def __init__(self) -> None:
        self._calls, self._launches, self._counting = itertools.count(), itertools.count(), False
        launch = cl.enqueue_nd_range_kernel

        def launched(*arguments, **options):
            next(self._launches)
            return launch(*arguments, **options)

        mock.patch.object(cl, "enqueue_nd_range_kernel", launched).start()
        threading.setprofile(self._profile)
        sys.setprofile(self._profile)

    def _profile(self, frame, event, argument) -> None:
        if self._counting and event in {"call", "c_call"}:
            next(self._calls)

    def of(self, *works: Callable[[], object]) -> tuple[int, int]:
        """Return the calls and launches of a function, or of the cheapest of several like it.

        After kernels have been compiled, other threads may still be busy with them.
        """
        counts = []
        for work in works:
            self._calls, self._launches, self._counting = itertools.count(), itertools.count(), True
            work()
            self._counting = False
            counts.append((next(self._calls), next(self._launches)))
        return min(counts)


def measured(folder: Path) -> dict[str, tuple[float, float]]:
    """Return the calls and launches of each kind of work, on renders that are made in a folder."""
    from tests.test_batch import worker_of

    rng = np.random.default_rng(0)
    (folder / "in").mkdir()
    for i in range(50):
        pixels = rng.random((96, 96, 3)).astype(np.float32) / 2
        write_exr(folder / f"in/r{i:03}.exr", pixels, "RGB", {}, half=True)
    count, found = Counter(), {}

    drawn = {"camera": {"choice": CAMERAS}, "iso": {"log_uniform": [200, 3200]}}
    samples = clpipe.Dataset(folder / "in", patch=64, raw="packed", **drawn)
    batches = [range(first, first + 16) for first in range(0, 400, 16)]
    for batch in batches:  # so that all kernels are compiled, and all families known
        samples.__getitems__(batch)
    samples.set_epoch(1)
    calls, launches = count.of(*(partial(samples.__getitems__, batch) for batch in batches[:3]))
    found["drawn sample"] = calls / 16, launches / 16

    samples = clpipe.Dataset(folder / "in", patch=64)
    samples[0], samples[1]
    found["sample"] = count.of(*(partial(samples.__getitem__, i) for i in range(2, 5)))

    camera, image = clpipe.Pipeline(), rng.random((64, 64, 3), np.float32)
    camera.process(image, "a"), camera.process(image, "a", iso=1000)
    keys = "bcd"
    found["process"] = count.of(*(partial(camera.process, image, key) for key in keys))
    for iso in (1020, 1040, 1060):
        camera.process(image, "a", iso=iso)
    changed = (partial(camera.process, image, k, iso=1100 + i) for i, k in enumerate(keys))
    found["process with settings"] = count.of(*changed)

    (folder / "out").mkdir()
    worker, jobs = worker_of(folder)
    (device,) = open_devices()

    def run(part):
        outcomes = Batch(worker, [device], 1, in_flight=1).run(part)
        assert [outcome.status for outcome in outcomes] == ["done"] * len(part)

    run(jobs[:2])
    few, many = count.of(lambda: run(jobs[2:18])), count.of(lambda: run(jobs[18:]))
    found["image of run"] = tuple((b - a) / 16 for a, b in zip(few, many, strict=True))
    return found


@pytest.fixture(scope="module")
def costs(device, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cost")
    return json.loads(run_python("-m", "tests.test_cost", folder, cwd=ROOT).stdout)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("work", "calls", "launches"),
    [
        # Noisy and clean, raw and picture, of 16 patches, a camera and an ISO drawn for each.
        ("drawn sample", 1_880, 35 / 16),
        ("sample", 2_130, 12),
        ("process", 880, 7),
        ("process with settings", 1_040, 7),
        ("image of run", 3_200, 7 / 16),  # small ones, which share launches
    ],
)
def test_what_work_costs(costs, work, calls, launches):
    assert costs[work][0] <= calls * SLACK
    assert costs[work][1] <= launches


if __name__ == "__main__":
    print(json.dumps(measured(Path(sys.argv[1]))))
