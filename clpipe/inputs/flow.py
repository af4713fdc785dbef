"""Optical flow leads between frames of one geometry, which is checked before a sequence is made."""

from collections.abc import Sequence
from itertools import groupby

from clpipe.base.errors import ImageError, RequestError
from clpipe.inputs.companions import find_carried_layers
from clpipe.inputs.jobs import Job
from clpipe.inputs.loader import ImageLoader
from clpipe.inputs.metering import with_drawn
from clpipe.inputs.sequences import sequence_of
from clpipe.reference.geometry import Geometry


def check_flow(loader: ImageLoader, jobs: Sequence[Job]) -> None:
    """Check that all frames of a sequence have one lens and size, if a carried layer is flow.

    The end of a vector is mapped by the geometry of its own frame, so it would otherwise be wrong.

    Args:
        loader: the loader of the run.
        jobs: the frames, in the order of :func:`~clpipe.inputs.sequences.in_sequences`.

    Raises:
        RequestError: two frames differ.
    """
    specs = loader.request.aov_specs()
    if loader.kept or not specs:
        return
    for sequence, frames in groupby(jobs, key=sequence_of):
        first: tuple[Job, Geometry | None] | None = None
        for job in frames:
            try:
                layers = () if first else find_carried_layers(job.path, specs)
                if not (first or any(each.kind == "flow" for each in layers)):
                    break
                geometry = loader.for_job(with_drawn(loader, job)).chain.geometry
            except (ImageError, RequestError):
                continue  # the run reports it for this frame
            first = first or (job, geometry)
            if geometry != first[1]:
                raise RequestError(
                    f"--carry: {job.label} has another lens, zoom or crop than {first[0].label}. "
                    f"Optical flow needs the same one in all frames of the sequence {sequence}. "
                    "Set one value for all of them, or carry no flow"
                )
