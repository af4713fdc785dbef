"""Verdicts on OpenCL runtimes: each is tested once, in a child process, and the result is cached.

The test, :mod:`clpipe.engine.trial`, detects runtimes that crash, cannot compile or compute wrong
results, before a user meets them. The results are in the cache folder. They are valid for one CPU,
one set of drivers and versions, and one version of the test.
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

LIMIT = 120  # seconds for one process; after that, the runtime under test counts as hanging
WINDOWS_FAULT = 0xC0000000  # the least exit status of a process that Windows has terminated
SLOW = "it takes longer than"
SENSITIVE = (*VARIABLES, VARIABLE, "POCL_DEVICES", "LD_LIBRARY_PATH", "LD_PRELOAD")


@dataclass(frozen=True)
class Verdicts:
    """The results of tests.

    Args:
        listing: why the platforms cannot be listed; "" if they can.
        hidden: why a driver is hidden from the loader, by its name in
            :func:`~clpipe.engine.vendors.installed_drivers`.
        platforms: why a platform's devices cannot be listed, by :func:`platform_id`.
        attempts: why a device does not work, by :func:`attempt`; "" if it works.
        lasting: whether the results are also valid for later processes.
    """

    listing: str = ""
    hidden: dict[str, str] = field(default_factory=dict)
    platforms: dict[str, str] = field(default_factory=dict)
    attempts: dict[str, str] = field(default_factory=dict)
    lasting: bool = True

    @property
    def problems(self) -> bool:
        """Whether any test failed."""
        return bool(self.listing or self.hidden or self.platforms or any(self.attempts.values()))

    def of(self, platform: Any, device: Any) -> tuple[Target, str] | None:
        """Return a device's target, and why it does not work or ""; None if it was not tested."""
        targets = candidates(platform, device)
        found = {t: self.attempts.get(attempt(platform, device, t)) for t in targets}
        works = next((t for t, problem in found.items() if problem == ""), None)
        if works:
            return works, ""
        first = found[targets[0]]
        return None if first is None else (targets[0], first)


def verdicts(again: bool = False, missing: Sequence[str] = ()) -> Verdicts:
    """Return the verdicts on this machine's runtimes. Runtimes without a verdict are tested.

    Args:
        again: whether to repeat failed tests.
        missing: the names of missing tests, from :func:`attempt`. A device counts as working if its
            test is still missing afterwards, because the child process does not see the device.
    """
    store, state = _store(), _state()
    known = _known(store.load("runtimes", state))
    if known and again and known.problems:
        known = None
    if known and not missing:
        return known
    found = run_tests(known or Verdicts())
    for name in missing:
        found.attempts.setdefault(name, "")
    if found.lasting:
        store.keep(json.dumps(asdict(found)).encode(), "runtimes", state)
    return found


def run_tests(known: Verdicts) -> Verdicts:
    """Complete the verdicts. After a crash, the next process skips the runtime that caused it."""
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
        # A time-out may only mean that the machine is too busy.
        known = replace(known, lasting=known.lasting and not ending.startswith(SLOW))
        if ending == "" or not at:  # the test could not run, so no runtime is to blame
            return replace(known, lasting=False)
        if at["at"] == "list":
            found = _crashing_drivers(known)
            if not found:
                return replace(known, listing=ending)
            known.hidden.update(found)
            continue
        of = known.platforms if at["at"] == "platform" else known.attempts
        if at["name"] in of:
            return replace(known, lasting=False)
        of[at["name"]] = ending


def _crashing_drivers(known: Verdicts) -> dict[str, str]:
    """Return the drivers that crash a process that lists only them, and how.

    The drivers' devices are also listed: if a loader has several drivers, it asks each for devices,
    to put drivers with devices first.
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
    """Run the test in a child process.

    Returns:
        The lines that it wrote, and why it ended early, in words. The reason is None if it ran to
        its end, and "" if no runtime is to blame.
    """
    environment = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        with drivers_visible(known.hidden):  # here, because a killed child would not clean up
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
    except (OSError, ValueError):  # no such program, for example in an embedded interpreter
        return [], ""
    lines = list(_parsed(output))
    if status is None:
        return lines, f"{SLOW} {LIMIT} s for a tiny kernel"
    if status >= WINDOWS_FAULT:
        return lines, f"it crashes the process ({status:#x})"
    if status >= 0:
        return lines, None if status == 0 else ""
    if -status == getattr(signal, "SIGKILL", None):  # most likely out of memory
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
    """Return the cache of verdicts; without a cache folder, it lasts as long as this process."""
    folder = cache_folder() or process_folder()
    return Store(folder / "known" if folder else None)


def _state() -> str:
    """Return a text with the conditions of verdicts: this machine, its drivers and the test."""
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
    """Return the files of clpipe that the test depends on."""
    modules = [Path(__file__).with_name(f"{m}.py") for m in ("trial", "cpu_target", "runtimes")]
    return [*modules, *(kernel_folder() / f"lib/{name}.h" for name in LIBRARY)]


def _known(data: bytes | None) -> Verdicts | None:
    """Return verdicts from their cached form; None for None."""
    return Verdicts(**json.loads(data)) if data else None
