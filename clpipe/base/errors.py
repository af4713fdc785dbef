"""Errors for users, by cause. Each class has the exit status of the program."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

from clpipe.base.text import one_line

MAX_LENGTH = 4000  # characters of a message, because text quoted from a file can have any length


class ClpipeError(Exception):
    """Base of all errors that clpipe reports as a message without a traceback.

    >>> import clpipe
    >>> try:
    ...     clpipe.Pipeline(denoise={"luma_strength": -1})
    ... except clpipe.ClpipeError as error:
    ...     print(error)
    denoise.luma_strength: found -1: should be greater than or equal to 0

    Attributes:
        exit_status: the exit status of a command.
        error_class: the class of the cause, see :func:`error_class`.
    """

    exit_status = 2
    error_class = "request"  # the class of its cause in run.jsonl

    def __str__(self) -> str:
        text = super().__str__()
        half = MAX_LENGTH // 2
        return text if len(text) <= MAX_LENGTH else f"{text[:half]} ... {text[-half:]}"


class RequestError(ClpipeError, ValueError):
    """The request is wrong: an unknown name, a bad value, or a chain that does not fit.

    >>> import clpipe
    >>> try:
    ...     clpipe.load_camera("sony-a7r9")
    ... except ValueError as error:
    ...     print(type(error).__name__)
    RequestError
    """

    exit_status = 2


class MissingError(RequestError):
    """A named file or folder does not exist. ``name`` is the name as the user wrote it."""

    def __init__(self, name: str, message: str) -> None:
        super().__init__(message)
        self.name = name

    def __reduce__(self) -> tuple[Any, ...]:
        return MissingError, (self.name, *self.args)


class KeyedError(RequestError):
    """A setting is invalid. ``key`` is its dotted name, such as ``sensor_noise.a``."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(message)
        self.key = key

    def __reduce__(self) -> tuple[Any, ...]:
        return KeyedError, (self.key, *self.args)


class ImageError(ClpipeError):
    """One image cannot be read, processed or written. A run continues with the others.

    >>> import numpy as np
    >>> import clpipe
    >>> try:
    ...     clpipe.Pipeline(device="numpy").process(np.zeros((4, 6, 2), np.float32), "a")
    ... except clpipe.ImageError as error:
    ...     print(str(error).partition(". ")[0])
    a: the image has shape (4, 6, 2), but (height, width, 3) is expected

    Args:
        message: the problem.
        way: a sentence about options that help. It is not part of the text, because some commands
            lack these options.
    """

    exit_status = 1
    error_class = "image"

    def __init__(self, message: str = "", way: str = "") -> None:
        super().__init__(message)
        self.way = way

    @property
    def with_way(self) -> Self:
        """The same error with the sentence ``way`` in its message."""
        return type(self)(f"{self}. {self.way}") if self.way else self


class NoPictureError(ImageError):
    """A file is a valid image, but lacks the channels to read. For example, it has only depth."""


class KindError(ImageError):
    """A kept image lacks the required channels. ``attributes`` come from the file."""

    def __init__(self, path: Path, attributes: Mapping[str, str]) -> None:
        stage = attributes.get("stage", "a stage that it does not name")
        content = one_line(f"{attributes['kind']}, kept after {stage}")
        super().__init__(f"{path}: holds {content}")
        self.attributes = attributes


class MemoryLimitError(ImageError):
    """One image needs more memory than this machine, the device or an option allows."""

    error_class = "memory"


class DeviceFailedError(ImageError):
    """A device failed for one image, also at the second try. Other images may succeed."""

    error_class = "device"


class DeviceError(ClpipeError):
    """There is no usable device, or the requested device cannot be used.

    >>> import clpipe
    >>> try:
    ...     clpipe.Pipeline(device="no such device")
    ... except clpipe.DeviceError as error:
    ...     print(type(error).__name__)
    DeviceError
    """

    exit_status = 3
    error_class = "device"


class OutputError(ClpipeError):
    """No more files can be written: the disk is full, or the output directory is missing."""

    exit_status = 1
    error_class = "output"


class TransferError(ClpipeError):
    """A service does not answer, or asks for fewer requests. The same command may succeed later."""

    exit_status = 1


class ClusterError(ClpipeError):
    """The cluster was lost during a run. The images finished before are written."""

    exit_status = 1


def error_class(error: BaseException) -> str:
    """Return the class of an error's cause, for run.jsonl.

    "not_found", "auth", "throttled" and "network" are errors of a URL; "stopped" means that the run
    was stopped before its file arrived. "damaged" is a file that
    cannot be read as an image, and "image" another problem of one image. "memory", "device" and
    "output" name what failed, "request" is a wrong setting, and "unexpected" a defect of clpipe.

    >>> error_class(MemoryError()), error_class(DeviceError("lost")), error_class(KeyError("a"))
    ('memory', 'device', 'unexpected')
    """
    if isinstance(error, MemoryError):
        return "memory"
    return error.error_class if isinstance(error, ClpipeError) else "unexpected"
