"""What the pictures of a run share, in a file that their sidecars name by its digest.

The file is ``DIGEST.run``, with the first digits of its SHA-256. It contains the device, the
versions of libraries, and the response to greys. A sidecar without it still replays.
"""

import hashlib
import os
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from clpipe.base.about import FORMAT, FORMAT_KEY, __version__
from clpipe.base.cache import Identity
from clpipe.base.errors import ImageError
from clpipe.base.files import atomic_file
from clpipe.base.reading import parse_json, read_bytes
from clpipe.outputs.sidecar import VERSION_KEY, json_text

SHARED = "run"  # the key of a sidecar with the digest, and the extension of the file

ENVIRONMENT = ("device", "versions")  # keys of the file that are not in a sidecar
PHOTOMETRY, RESPONSE = "photometry", "response"


def shared_path(folder: Path, digest: str) -> Path:
    """Return the file for a digest.

    >>> shared_path(Path("out"), "0123456789abcdef" * 4)
    PosixPath('out/0123456789abcdef.run')
    """
    return folder / f"{digest[:16]}.{SHARED}"


def share(record: Mapping[str, Any], place: Path, shares_response: bool) -> dict[str, Any]:
    """Return a sidecar's values without those that its run shares, and write these to a file.

    Args:
        record: all values.
        place: a path next to the file, whose stem names the run's image, tar or clip.
        shares_response: whether the other pictures of the run have the same response.

    Raises:
        ImageError: the file cannot be written.
    """
    values = {key: value for key, value in record.items() if key not in ENVIRONMENT}
    response = None
    if shares_response and (photometry := record[PHOTOMETRY]):
        values[PHOTOMETRY] = {k: v for k, v in photometry.items() if k != RESPONSE}
        response = Identity(photometry[RESPONSE])
    device, versions = (record[key] for key in ENVIRONMENT)
    data, digest = _encoded(tuple(device.items()), Identity(versions), response)
    name = f"{digest[:16]}.{SHARED}"
    if not os.path.exists(os.path.join(os.path.dirname(place), name)):
        with atomic_file(place.with_name(name), place.stem) as file:
            file.write(data)
    return {**values, SHARED: digest}


@lru_cache(maxsize=64)
def _encoded(
    device: tuple[tuple[str, Any], ...], versions: Identity, response: Identity | None
) -> tuple[bytes, str]:
    """Return the bytes of a shared file, and their SHA-256. Images have the same objects."""
    shared = {FORMAT_KEY: FORMAT, VERSION_KEY: __version__}
    values = zip(ENVIRONMENT, (dict(device), versions.of), strict=True)
    shared |= {**dict(values), **({RESPONSE: response.of} if response else {})}
    data = json_text(shared).encode()
    return data, hashlib.sha256(data).hexdigest()


def with_shared(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the values of a sidecar with those that its run shares.

    If the file is missing or was changed, these values are missing as well.

    Args:
        values: the values of the sidecar.
        folder: the folder of the sidecar, or of its tar.
    """
    whole = dict(values)
    if (digest := whole.get(SHARED)) is None:
        return whole
    try:
        data = read_bytes(shared_path(folder, str(digest)))
        shared = parse_json(data) if hashlib.sha256(data).hexdigest() == digest else {}
    except (OSError, ValueError, ImageError):
        return whole
    whole |= {key: shared[key] for key in ENVIRONMENT if key in shared}
    if RESPONSE in shared and isinstance(photometry := whole.get(PHOTOMETRY), dict):
        whole[PHOTOMETRY] = {**photometry, RESPONSE: shared[RESPONSE]}
    return whole
