"""Pictures of an output folder whose inputs are not there any more."""

import os
from collections.abc import Sequence
from pathlib import Path

from clpipe.base.reading import read_bytes
from clpipe.inputs.find import Job
from clpipe.outputs.planned import PlannedOutputs, ending_behind
from clpipe.outputs.sidecar import SIDECAR, SidecarError, values_in


def pictures_without_input(
    outputs: PlannedOutputs, jobs: Sequence[Job], inputs: Sequence[str]
) -> int:
    """How many pictures of the output folder are of inputs that were removed or renamed.

    Only those inputs count that lay in a folder which is an input now, or beside one: names in
    sidecars are relative to where that run was started.

    Args:
        outputs: of the run.
        jobs: all of it.
        inputs: as the user gave them.
    """
    own = {
        outputs.name(job, ending_behind(SIDECAR, each))
        for job in jobs
        for each in outputs.renditions_of(job)
    }
    beside = {Path(text) for text in {os.path.dirname(job.input) for job in jobs}}
    below = [Path(text) for text in inputs if os.path.isdir(text)]
    count = 0
    for place, folders, names in os.walk(outputs.folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if not name.endswith(f".{SIDECAR}") or f"{place}/{name}" in own:
                continue
            path = Path(place, name)
            try:
                values = values_in(read_bytes(path), path) or {}
            except (OSError, SidecarError):
                continue
            render = values.get("input")
            if not isinstance(render, str) or os.path.lexists(render):
                continue
            was = Path(render)
            count += was.parent in beside or any(was.is_relative_to(each) for each in below)
    return count
