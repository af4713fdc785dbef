"""Options of a run that do not change its pictures, such as devices and threads."""

from dataclasses import dataclass
from pathlib import Path

from clpipe.base.errors import RequestError
from clpipe.outputs.existing import Redo


@dataclass(frozen=True)
class FailureLimit:
    """The most images of a run that may fail: a number, or a percentage of all."""

    value: float
    is_percentage: bool

    def count(self, images: int) -> int:
        """Return the most failures among a number of images.

        >>> FailureLimit(2.5, True).count(1000), FailureLimit(3, False).count(1000)
        (25, 3)
        """
        return int(self.value * images / 100 if self.is_percentage else self.value)


def parse_failures(text: str) -> FailureLimit:
    """Return the limit in a text such as "10" or "2.5%".

    Raises:
        RequestError: the text does not have that form.
    """
    is_percentage = text.endswith("%")
    try:
        value = float(text[:-1]) if is_percentage else int(text)
    except ValueError:
        value = -1
    if not 0 <= value <= (100 if is_percentage else 10**9):
        raise RequestError(
            f"--max-failures: found {text!r}; expected a number of images such as 10, or a "
            "percentage from 0% to 100%"
        )
    return FailureLimit(value, is_percentage)


@dataclass(frozen=True)
class ExecutionOptions:
    """Where and how a run is executed. Its pictures do not depend on these options.

    Args:
        output: the output directory.
        devices: indices or parts of names from ``clpipe devices``, or "numpy". () is the first GPU
            and all GPUs like it, or else the CPU.
        memory: the memory limit of a device in bytes. Larger images are processed in tiles. None
            is the free memory.
        threads: the number of threads that decode, and of threads that encode. None is one per
            processor.
        redo: which existing pictures are recomputed.
        trace: the file for a timeline, or None.
        processes: the number of processes that share the work on this machine. None chooses it
            from the number and size of the images.
        max_failures: the most images that may fail before the run stops. None is no limit.
    """

    output: Path
    devices: tuple[str, ...] = ()
    memory: int | None = None
    threads: int | None = None
    redo: Redo = Redo.OLD
    trace: Path | None = None
    processes: int | None = None
    max_failures: FailureLimit | None = None
