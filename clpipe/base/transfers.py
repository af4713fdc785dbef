"""Requests to the file systems of URLs: their retries, their deadlines, and what their errors mean.

This is the only layer of retries for S3: s3fs and botocore try each request once. The libraries of
other services may retry within a try.
"""

import queue
import random
import re
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

from clpipe.base.errors import ClpipeError, RequestError, TransferError
from clpipe.base.extras import require
from clpipe.base.text import one_line
from clpipe.base.url_text import name_in

T = TypeVar("T")

MAX_TRIES = 12
FIRST_WAIT, LAST_WAIT = 0.25, 8.0  # s; each wait is twice as long as the one before
RETRY_SECONDS = 60.0  # s after the first try; no try begins later
TRY_SECONDS, MIN_SPEED = 30.0, 100_000  # a try may take these seconds, plus a second per such bytes
STOP_SECONDS = 8.0  # s; the time that a transfer has after a stop
POLL_SECONDS = 0.2  # s

# The class of an error, by the name of its type and the code of the service.
CLASSES = {
    "auth": r"Permission|Denied|Expired|Token|Signature|Skewed|AccessKey|Credential"
    r"|Authenti|Authori|Forbidden|\b40[013]$",  # S3 answers 400 to HEAD if a token has expired
    "not_found": r"NotFound|NoSuch|KeyError|\b(404|410)$",  # KeyError: of a file in an archive
    "throttled": r"SlowDown|Throttl|TooMany|Busy|RequestLimit|ServiceUnavailable|\b(429|503)$",
}
FINAL = ("auth", "not_found", "stopped")  # no further try helps
MEANINGS = {"auth": "access is denied", "not_found": "there is no such file"}
ADVICE = {
    "auth": ". Renew or correct the credentials, then repeat the command",
    "throttled": ". Repeat the command later, or use fewer processes",
}
NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound")

# The packages of the extra "cloud" that file systems need, by scheme.
PACKAGES = {
    **dict.fromkeys(("s3", "s3a"), "s3fs"),
    **dict.fromkeys(("gs", "gcs"), "gcsfs"),
    **dict.fromkeys(("az", "abfs", "abfss", "adl"), "adlfs"),
    **dict.fromkeys(("http", "https"), "aiohttp"),
}


class Transfers:
    """Whether a stop was asked of this process, and when."""

    def __init__(self) -> None:
        self.stopped_at: float | None = None  # s of time.monotonic()

    def stop(self) -> None:
        """End all transfers after :data:`STOP_SECONDS`. Later ones get one short try."""
        self.stopped_at = self.stopped_at or time.monotonic()

    def allow(self) -> None:
        """Forget the stop."""
        self.stopped_at = None


TRANSFERS = Transfers()


class _AbandonedError(TimeoutError):
    """A thread goes on with a transfer, but nothing waits for it."""


def with_retries(
    url: str,
    work: Callable[[Any, str], T],
    error_type: type[ClpipeError],
    what: str,
    size: Callable[[], int] = lambda: 0,
) -> T:
    """Return the result of a function for a URL's file system and the path in it.

    The function is retried after errors that may be temporary. It runs in a thread of its own, and
    may go on there after its deadline.

    Args:
        url: the URL.
        work: the function.
        error_type: the type of the error.
        what: what the function does, as a participle such as "read".
        size: returns the number of bytes to transfer, as far as known, which extends the deadline.

    Raises:
        RequestError: as for :func:`check_scheme`.
        ClpipeError: all tries failed. The error has the type ``error_type``, or is a TransferError
            if that is RequestError and the request may succeed later.
    """
    check_scheme(url)
    began, wait = time.monotonic(), FIRST_WAIT
    for tries in range(1, MAX_TRIES + 1):
        try:
            system, path = _system_of(url)
            return _within(partial(work, system, path), size)
        except Exception as error:
            if isinstance(error, _AbandonedError):
                type(system).clear_instance_cache()  # its connections may never become free
            error_class = "stopped" if TRANSFERS.stopped_at else class_of(error)
            is_last = tries == MAX_TRIES or time.monotonic() - began + wait > RETRY_SECONDS
            is_permanent = isinstance(error, IsADirectoryError | NotImplementedError)
            if is_last or is_permanent or error_class in FINAL:
                text = f"{url}: cannot be {what}: {_reason(url, error, error_class, tries)}"
                may_pass = error_type is RequestError and error_class not in MEANINGS
                failure = (TransferError if may_pass else error_type)(text)
                failure.error_class = error_class
                raise failure from None
        _sleep(wait * random.uniform(0.5, 1.0))  # noqa: S311 - no secret
        wait = min(2 * wait, LAST_WAIT)
    raise AssertionError


def check_scheme(url: str) -> None:
    """Check that fsspec knows a URL's scheme, without contacting a server.

    Raises:
        RequestError: the scheme is unknown, or a package is missing. The message names the package.
    """
    schemes = [part.partition("://")[0] for part in url.split("::") if "://" in part]
    packages = [PACKAGES[scheme] for scheme in schemes if scheme in PACKAGES]
    require(url, "cloud", "fsspec", *packages)
    if "://" not in name_in(url):
        raise RequestError(
            f"{url}: clpipe fetches each file once, so it needs no cache; use "
            f"{url.partition('::')[2]}"
        )
    from fsspec import get_filesystem_class

    try:
        for scheme in schemes:
            get_filesystem_class(scheme)
    except (ImportError, ValueError) as error:
        raise RequestError(f"{url}: {one_line(str(error))}") from None


def class_of(error: BaseException) -> str:
    """Return the class of a file system's error: one of :data:`CLASSES`, or "network".

    >>> class_of(FileNotFoundError("a.exr")), class_of(OSError("reset by peer"))
    ('not_found', 'network')
    """
    text = f"{type(error).__name__} {service_code(error)}".strip()
    return next((name for name, form in CLASSES.items() if re.search(form, text)), "network")


def service_code(error: BaseException) -> str:
    """Return the code with which a service answered, such as "SlowDown" or "403"; "" if none."""
    for each in (error, error.__cause__):
        response = getattr(each, "response", None)  # of botocore
        if isinstance(response, Mapping):
            return str(response.get("Error", {}).get("Code", ""))
        for name in ("error_code", "status", "status_code", "code"):
            value = getattr(each, name, None)
            if isinstance(value, int | str) and value:
                return str(getattr(value, "value", value))
    return ""


def _system_of(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, which does not retry if that can be set, and the path."""
    from fsspec.core import url_to_fs

    if PACKAGES.get(url.partition("://")[0], "aiohttp") == "aiohttp":
        return url_to_fs(url)
    # Listings of these services are remembered in clpipe.base.urls. The option also gives clpipe
    # an instance that other code of this process does not use.
    system, path = url_to_fs(url, use_listings_cache=False)
    if PACKAGES[url.partition("://")[0]] == "s3fs" and system.retries != 1:
        system.retries = 1
        once = {"retries": {"total_max_attempts": 1}}  # botocore's
        system.config_kwargs = {**once, **system.config_kwargs}
    return system, path


def _within(work: Callable[[], T], size: Callable[[], int]) -> T:
    """Return the result of a function, which a thread runs.

    Raises:
        _AbandonedError: it took too long for the bytes to transfer, or transfers were stopped.
        Exception: what the function raises.
    """
    results: queue.SimpleQueue[tuple[T | None, BaseException | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            results.put((work(), None))
        except BaseException as error:
            results.put((None, error))

    threading.Thread(target=run, name="transfer", daemon=True).start()
    began = time.monotonic()
    while True:
        seconds = TRY_SECONDS + size() / MIN_SPEED
        end = began + seconds
        if TRANSFERS.stopped_at:
            end = min(end, max(TRANSFERS.stopped_at + STOP_SECONDS, began + 1.0))
        with suppress(queue.Empty):
            value, error = results.get(timeout=min(max(end - time.monotonic(), 0), POLL_SECONDS))
            if error:
                raise error
            return value  # type: ignore[return-value]
        if time.monotonic() >= end:
            raise _AbandonedError(
                "the run was stopped"
                if TRANSFERS.stopped_at
                else f"it took more than {seconds:.0f} s"
            )


def _sleep(seconds: float) -> None:
    """Wait, but not after a stop."""
    end = time.monotonic() + seconds
    while not TRANSFERS.stopped_at and (left := end - time.monotonic()) > 0:
        time.sleep(min(left, POLL_SECONDS))


def _reason(url: str, error: Exception, error_class: str, tries: int) -> str:
    """Return what an error means, with the code of the service."""
    code = service_code(error)
    if NO_BUCKET.search(code):
        return f"there is no such bucket ({code}). Create it, or correct the URL"
    text = re.sub(r"^\[Errno \d+\] ", "", one_line(str(error))).strip("'/").rstrip(".")
    if text in url or text.isdigit():
        is_late = isinstance(error, TimeoutError)
        unknown = "the service did not answer in time" if is_late else type(error).__name__
        text = MEANINGS.get(error_class, unknown)
    text += f" ({code})" * bool(code and code not in text)
    text += f", in {tries} tries" * (tries > 1)
    return text + ADVICE.get(error_class, "")
