"""Writes the counts of a run in the text format of Prometheus."""

import time
from pathlib import Path

from clpipe.base.files import write_atomic
from clpipe.batch.run_log import Summary


def metrics_text(summary: Summary) -> str:
    """Return the counts of a run in the text format of Prometheus, version 0.0.4.

    >>> print(metrics_text(Summary(3)).splitlines()[2])
    clpipe_images_planned 3
    """
    statuses = {f'{{status="{s.replace(" ", "_")}"}}': n for s, n in summary.counts.items()}
    steps = {f'{{step="{s}"}}': t for s, t in summary.seconds.items()}
    metrics: list[tuple[str, str, str, dict[str, float]]] = [
        ("images_planned", "gauge", "Images of the run.", {"": summary.total}),
        ("images_total", "counter", "Images that have an outcome.", {**statuses}),
        ("megapixels_total", "counter", "Megapixels of images.", {"": summary.megapixels}),
        ("step_seconds_total", "counter", "Seconds of work of all threads.", steps),
        ("elapsed_seconds", "gauge", "Seconds since the start.", {"": summary.elapsed}),
        ("update_timestamp_seconds", "gauge", "When this was written.", {"": time.time()}),
    ]
    lines = []
    for name, kind, text, values in metrics:
        lines += [f"# HELP clpipe_{name} {text}", f"# TYPE clpipe_{name} {kind}"]
        lines += [f"clpipe_{name}{labels} {value:.15g}" for labels, value in values.items()]
    return "\n".join(lines) + "\n"


def write_metrics(path: Path, summary: Summary) -> None:
    """Write the counts of a run to a file, which is replaced.

    Raises:
        ImageError: it cannot be written.
    """
    write_atomic(path, metrics_text(summary).encode())
