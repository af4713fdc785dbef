"""Objects whose public attributes cannot be set."""

from typing import Any


class ReadOnly:
    """Refuses to set public attributes, since nothing would read the new value.

    >>> class Camera(ReadOnly):
    ...     pass
    >>> Camera().iso = 800
    Traceback (most recent call last):
    AttributeError: cannot set iso: a Camera does not change; make another one with iso=...
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_"):
            kind = type(self).__name__
            raise AttributeError(
                f"cannot set {name}: a {kind} does not change; make another one with {name}=..."
            )
        super().__setattr__(name, value)
