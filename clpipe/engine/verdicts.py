"""Verdicts on OpenCL runtimes: each is tried once, in a child process, and the result is kept.

A runtime that crashes, compiles nothing or computes wrongly is found there, by
:mod:`clpipe.engine.trial`, and not by a user. What is known is bound to the CPU, the installed
drivers, their versions and the trial itself; it lies in the cache folder.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from clpipe.base.process_folder import process_folder
from clpipe.engine.cache_folder import cache_folder
from clpipe.engine.cpu_target import VARIABLE, Target, candidates, cpu_text
from clpipe.engine.runtimes import attempt
from clpipe.engine.sources import LIBRARY, kernel_folder
from clpipe.engine.store import Store
from clpipe.engine.vendors import VARIABLES, drivers_visible, icd_files, installed_drivers

LIMIT = 120  # seconds for one process; then the runtime that it is at counts as hanging
WINDOWS_FAULT = 0xC0000000  # the status of a process that the system has ended is no smaller
SLOW = "it takes longer than"
SENSITIVE = (*VARIABLES, VARIABLE, "POCL_DEVICES", "LD_LIBRARY_PATH", "LD_PRELOAD")


@dataclass(frozen=True)
class Verdicts:
    """Results of trials.

    Args:
        listing: why the platforms cannot be listed at all; "" where they can.
        hidden: why a driver is kept from the loader, by its name among
            :func:`~clpipe.engine.vendors.installed_drivers`.
        platforms: why a platform's devices cannot be asked for, by :func:`platform_id`.
        attempts: why a device does not work, or "", by :func:`attempt`.
        lasting: whether they hold for later processes, too.
    """

    listing: str = ""
    hidden: dict[str, str] = field(default_factory=dict)
    platforms: dict[str, str] = field(default_factory=dict)
    attempts: dict[str, str] = field(default_factory=dict)
    lasting: bool = True

    @property
    def problems(self) -> bool:
        """Whether anything failed."""
        return bool(self.listing or self.hidden or self.platforms or any(self.attempts.values()))

    def of(self, platform: Any, device: Any) -> tuple[Target, str] | None:
        """The target of a device, and why it does not work, or ""; None if it was not tried."""
        targets = candidates(platform, device)
        found = {t: self.attempts.get(attempt(platform, device, t)) for t in targets}
        works = next((t for t, problem in found.items() if problem == ""), None)
        if works:
            return works, ""
        first = found[targets[0]]
        return None if first is None else (targets[0], first)


def verdicts(again: bool = False, missing: Sequence[str] = ()) -> Verdicts:
    """The verdicts on this machine's runtimes, after they are tried if that is not known.

    Args:
        again: try what failed once more.
        missing: what was not tried, as :func:`attempt` names it. What is still missing then, since
            another process does not see it, is trusted.
    """
    store, state = _store(), _state()
    known = _known(store.load("runtimes", state))
    if known and again and known.problems:
        known = None
    if known and not missing:
        return known
    found = tried(known or Verdicts())
    for name in missing:
        found.attempts.setdefault(name, "")
    if found.lasting:
        store.keep(json.dumps(asdict(found)).encode(), "runtimes", state)
    return found


def tried(known: Verdicts) -> Verdicts:
    """Verdicts with all that was not known; what ends the process is passed over in the next."""
    while True:
        lines, ending = _run(known)
        at: dict[str, str] = {}
        for line in lines:
            if "at" in line:
                at = line
            else:
                known.attempts[line["attempt"]] = line["problem"]
                known = replace(known, lasting=known.lasting and not line["passing"])
                at = {}
        if ending is None:
            return known
        # A machine may be too busy.
        known = replace(known, lasting=known.lasting and not ending.startswith(SLOW))
        if ending == "" or not at:  # it could not be tried, which says nothing of the runtimes
            return replace(known, lasting=False)
        if at["at"] == "list":
            found = _that_end_the_listing(known)
            if not found:
                return replace(known, listing=ending)
            known.hidden.update(found)
            continue
        of = known.platforms if at["at"] == "platform" else known.attempts
        if at["name"] in of:
            return replace(known, lasting=False)
        of[at["name"]] = ending


def _that_end_the_listing(known: Verdicts) -> dict[str, str]:
    """The drivers that end a process which lists them and their devices, each alone; and how.

    A loader that has several asks each for its devices, to have those first that have some.
    """
    drivers = [name for name in installed_drivers() if name not in known.hidden]
    found = {}
    for name in drivers:
        others = dict.fromkeys([*known.hidden, *drivers], "")
        del others[name]
        _, ending = _run(replace(known, hidden=others), only_listing=True)
        if ending:
            found[name] = ending
    return found


def _run(known: Verdicts, only_listing: bool = False) -> tuple[list[dict[str, Any]], str | None]:
    """Run the trial: the lines that it wrote, and what ended it, in words.

    The latter is None where it came to its end, and "" where that is not the runtimes' doing.
    """
    environment = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        with drivers_visible(known.hidden):  # here, since a child that is ended tidies nothing up
            done = subprocess.run(
                [sys.executable, "-m", "clpipe.engine.trial"],
                input=json.dumps(asdict(known) | {"only_listing": only_listing}).encode(),
                capture_output=True,
                timeout=LIMIT,
                env=os.environ | environment,
                check=False,
            )
        output, errors, status = done.stdout, done.stderr, done.returncode
    except subprocess.TimeoutExpired as error:
        output, errors, status = error.stdout or b"", b"", None
    except (OSError, ValueError):  # there is no such program, as within others
        return [], ""
    lines = list(_parsed(output))
    if status is None:
        return lines, f"{SLOW} {LIMIT} s for a tiny kernel"
    if status >= WINDOWS_FAULT:
        return lines, f"it crashes the process ({status:#x})"
    if status >= 0:
        return lines, None if status == 0 else ""
    if -status == getattr(signal, "SIGKILL", None):  # most likely for want of memory
        return lines, ""
    said = [line.strip() for line in errors.decode("utf-8", "replace").splitlines()]
    last = next((f": {line[:200]}" for line in reversed(said) if line), "")
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    return lines, f"it crashes the process ({name}){last}"


def _parsed(output: bytes) -> Iterator[dict[str, Any]]:
    for line in output.splitlines():
        with suppress(ValueError):
            yield json.loads(line)


def _store() -> Store:
    """The store of verdicts; without a lasting folder, for this process."""
    folder = cache_folder() or process_folder()
    return Store(folder / "known" if folder else None)


def _state() -> str:
    """The conditions of verdicts: this machine, its drivers and the trial, in one text."""
    parts = {
        "cpu": cpu_text(),
        "sys": Path("/sys/devices/system/cpu").is_dir(),
        "environment": {name: os.environ.get(name) for name in SENSITIVE},
        "drivers": {str(path): text for path, text in icd_files()},
        "program": [sys.executable, version("pyopencl")],
        "trial": [[path.stat().st_size, path.stat().st_mtime_ns] for path in _trial_files()],
    }
    return json.dumps(parts, sort_keys=True)


def _trial_files() -> list[Path]:
    """The files of this program that a trial depends on."""
    modules = [Path(__file__).with_name(f"{m}.py") for m in ("trial", "cpu_target", "runtimes")]
    return [*modules, *(kernel_folder() / f"lib/{name}.h" for name in LIBRARY)]


def _known(data: bytes | None) -> Verdicts | None:
    """Verdicts as they are kept; None for none."""
    return Verdicts(**json.loads(data)) if data else None
