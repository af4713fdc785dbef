"""What can go wrong, by whose fault it is. Each class carries the exit status of the program."""

from collections.abc import Mapping
from pathlib import Path


class ClpipeError(Exception):
    """Base of all errors that are reported as one clear message, without a traceback."""

    exit_status = 2


class RequestError(ClpipeError):
    """The request was wrong: an unknown name, a bad value, a chain that does not fit."""

    exit_status = 2


class KeyedError(RequestError):
    """A bad setting; ``key`` is its dotted name."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(message)
        self.key = key


class ImageError(ClpipeError):
    """One image cannot be read, processed or written; the others go on."""

    exit_status = 1


class KindError(ImageError):
    """A kept image has not the channels that are wanted; ``attributes`` is what it says."""

    def __init__(self, path: Path, attributes: Mapping[str, str]) -> None:
        kept = attributes.get("stage", "nothing that it names")
        super().__init__(f"{path}: holds {attributes['kind']}, kept after {kept}")
        self.attributes = attributes


class DeviceError(ClpipeError):
    """There is no usable device, or the one that was asked for cannot be used."""

    exit_status = 3


class OutputError(ClpipeError):
    """Nothing can be written any more: the disk is full, or the folder has gone."""

    exit_status = 1


class ClusterError(ClpipeError):
    """The cluster has gone in the midst of a run; what is finished is there."""

    exit_status = 1
