"""Where a run takes place, and how it goes about it."""

from dataclasses import dataclass
from pathlib import Path

from clpipe.outputs.existing import Redo


@dataclass(frozen=True)
class Where:
    """Where a run takes place, and how it goes about it; its pictures depend on none of this.

    Args:
        output: the folder that the pictures go to.
        devices: indices and parts of names, as ``clpipe devices`` lists them, or "numpy"; none is
            the first GPU and all of its kind, else the CPU.
        memory: of a device, in bytes; larger images are done in tiles. None is what is free.
        threads: how many decode, and how many encode; None is one for each processor.
        redo: which pictures that are there already are made again.
        trace: the file of a timeline; None is none.
        processes: how many share the work on this machine; None is as many as pay.
    """

    output: Path
    devices: tuple[str, ...] = ()
    memory: int | None = None
    threads: int | None = None
    redo: Redo = Redo.OLD
    trace: Path | None = None
    processes: int | None = None
