"""Notes about lenses whose names are given incompletely."""

from collections.abc import Sequence

from clpipe.camera.lens import name_note
from clpipe.chain.lens_presets import PRESETS
from clpipe.chain.settings import Settings
from clpipe.inputs.jobs import Job


def lens_notes(settings: Settings, jobs: Sequence[Job]) -> list[str]:
    """Return a note for each lens that settings or jobs name by only a part of its name.

    Raises:
        KeyedError: as for :func:`clpipe.camera.lens.name_note`.
    """
    named = [*settings.names_of("lens"), *(job.values.get("lens") for job in jobs if job.values)]
    names = dict.fromkeys(
        name for name in named if isinstance(name, str) and name and name not in PRESETS
    )
    return list(filter(None, map(name_note, names)))
