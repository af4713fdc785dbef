"""Objects whose public attributes cannot be set."""

from typing import Any


class ReadOnly:
    """Rejects new values for public attributes, because no code would read them.

    >>> class Camera(ReadOnly):
    ...     pass
    >>> Camera().iso = 800
    Traceback (most recent call last):
    AttributeError: cannot set iso: a Camera is read-only. Create another one with iso=...
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_"):
            kind = type(self).__name__
            raise AttributeError(
                f"cannot set {name}: a {kind} is read-only. Create another one with {name}=..."
            )
        super().__setattr__(name, value)
