"""Keys that seed the noise of each image, so that no two images share noise by accident."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from clpipe.chain.settings import Settings

MAX_FRAMES = 100_000  # the most frames per image

DIGITS = 16  # hexadecimal digits of the digest of an image's content


def image_key(name: str, digest: str) -> str:
    """Return the key of an image: its name among the inputs, and a digest of its content.

    The name is the path relative to the input directory; for a single file, the file's name.

    >>> image_key("left/0001.exr", "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f0")
    'left/0001.exr@9f86d081884c7d65'
    """
    return f"{name}@{digest[:DIGITS]}"


def name_of_key(key: str) -> str:
    """Return the name in an image key, which seeds draws; all frames of a burst have the same one.

    >>> name_of_key("left/0001.exr@9f86d081884c7d65#3"), name_of_key("0001.exr")
    ('left/0001.exr', '0001.exr')
    """
    name, at, _ = key.rpartition("@")
    return name if at else key


def frame_key(key: str, frame: int | None) -> str:
    """Return the key of a burst's frame, counted from 0; None for an image without a burst.

    >>> frame_key("a.exr@9f86d081884c7d65", None), frame_key("a.exr@9f86d081884c7d65", 0)
    ('a.exr@9f86d081884c7d65', 'a.exr@9f86d081884c7d65#0')
    """
    return key if frame is None else f"{key}#{frame}"


def bracket_key(key: str, ev: float) -> str:
    """Return the key of an image's exposure in a bracket. At 0 EV it is the image's key.

    >>> bracket_key("a.exr@9f86d081884c7d65", -2), bracket_key("a.exr@9f86d081884c7d65", 0)
    ('a.exr@9f86d081884c7d65#ev-2', 'a.exr@9f86d081884c7d65')
    """
    return f"{key}#ev{ev:+g}" if ev else key


def noise_key(settings: "Settings", key: str, frame: int | None = None) -> str:
    """Return the key that seeds noise together with the seed and the stage: the image and the ISO.

    The first frame of a burst, or epoch, has the same noise as the image without a burst.

    All settings with the same ``noise_key`` have the same noise, at any image and ISO (common
    random numbers).

    >>> from clpipe.chain.settings import Settings
    >>> noise_key(Settings(iso=3200.0), "a.exr@9f86d081884c7d65", 1)
    'a.exr@9f86d081884c7d65#1@ISO3200'
    >>> noise_key(Settings(noise_key="pair 7"), "a.exr@9f86d081884c7d65", 1)
    'pair 7#1'
    """
    key_of_frame = frame_key(settings.noise_key or key, frame or None).removesuffix("#0")
    return key_of_frame if settings.noise_key else f"{key_of_frame}@ISO{settings.iso:.9g}"
