"""Interrupt batches by failing writes, resume them, and compare all files with an undisturbed run.

    tools/run stress faults [--images N] [--repeats N] [--seed N] [--device SEL] [FAULT...]

A fault occurs at a random byte of the output (faults.c, which needs a C compiler):

- full: the disk is full from there on.
- eio: one write fails.
- short: one write accepts a part of its data, which is not an error.
- power: the power fails. Writes and renames since the last fsync are lost.

Each trial has a new output directory. A batch writes pictures of three kinds with sidecars, or
tars. Every image that the summary counts as done must exist. Then the same command resumes. It must
write every file of the undisturbed run, byte for byte, leave no temporary files, and change no
foreign files. The exit status is 1 after any failure.
"""

import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from clpipe.images.write import write_exr
from tools import ROOT
from tools.shared.options import count_of, parser_of

FOREIGN = {
    "notes.txt": b"not clpipe's",
    "pictures/other.jpg": b"\xff\xd8 somebody's",
    "z.json": b"{}",
}
KINDS = {
    "folder": ("--keep", "normalize", "--truth", "mosaic"),
    "tars": ("--webdataset", "7"),
}
FAULTS = ("full", "eio", "short", "power")
LIMIT = 600  # s, for one run


class Trial:
    """A batch with its own output directory, disturbed once and then resumed."""

    def __init__(self, place: Path, output: str, device: str, rng: random.Random) -> None:
        self.place, self.rng = place, rng
        self.out, self.log = place / "out", place / "operations"
        for name, data in FOREIGN.items():
            path = self.out / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        self.arguments = ["run", "in", "-o", str(self.out), "--device", device, *KINDS[output]]
        self.stderr = ""

    def run(self, **variables: str) -> int:
        """Run in the folder of the inputs, set ``stderr``, and return the exit status."""
        done = subprocess.run(
            [sys.executable, "-m", "clpipe", *self.arguments],
            cwd=self.place.parent,
            env={**os.environ, "PYTHONPATH": str(ROOT), **variables},
            capture_output=True,
            text=True,
            timeout=LIMIT,
            check=False,
        )
        self.stderr = done.stderr
        return done.returncode

    def run_with_fault(self, fault: str, size: int) -> None:
        """Run with a fault at a random one of ``size`` bytes."""
        status = self.run(
            LD_PRELOAD=str(self.place.parent / "faults.so"),
            FAULTS_DIR=str(self.out),
            FAULTS_KIND="kill" if fault == "power" else fault,
            FAULTS_AT=str(self.rng.randrange(size)),
            FAULTS_LOG=str(self.log),
        )
        if fault == "power":
            self._lose_unsynced()
            return
        allowed = (0,) if fault == "short" else (0, 1, 2)
        assert status in allowed, f"ended with {status}: {self.stderr[-400:]}"

    def _lose_unsynced(self) -> None:
        unsynced: set[str] = set()
        renamed: dict[str, str] = {}
        for line in self.log.read_text("utf-8", "surrogateescape").splitlines():
            what, one, two = line.split("\t")
            if what == "write":
                unsynced.add(one)
            elif what == "fsync":
                unsynced.discard(one)
                renamed = {to: name for to, name in renamed.items() if os.path.dirname(to) != one}
            else:
                if one in unsynced:
                    unsynced.discard(one)
                    unsynced.add(two)
                renamed[two] = one
        for path in filter(os.path.exists, unsynced):
            size = os.path.getsize(path)
            os.truncate(path, self.rng.randrange(size + 1))
            if self.rng.random() < 0.5:  # its blocks were allocated but not written
                os.truncate(path, 0)
                os.truncate(path, size)
        for to, name in renamed.items():
            if os.path.exists(to) and self.rng.random() < 0.5:
                os.rename(to, name)
        for path in self.out.rglob("*.json*"):  # a log may end in zeros, a sidecar must not
            is_unfinished = path.name == "run.jsonl" or ".part." in path.name
            assert is_unfinished or path.read_bytes().strip(b"\0")


def files(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder, except logs and foreign files."""
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {n: p.read_bytes() for n, p in found.items() if n != "run.jsonl" and n not in FOREIGN}


def check_claims(trial: Trial, reference: dict[str, bytes]) -> None:
    """Check that images that the summary counts as done exist and are correct."""
    made = files(trial.out)
    for name, data in made.items():
        is_temporary = ".part" in name or name.startswith(".clpipe")
        if not is_temporary and not name.endswith(".tar"):  # unfinished tars may differ
            assert data == reference.get(name), f"{name} is damaged under its final name"
    match = re.search(r"(\d+) of \d+ images? done", trial.stderr)
    if match and not any(name.endswith(".tar") for name in reference):
        own = [n for n in made if n.endswith(".json") and ".truth" not in n and ".part" not in n]
        assert int(match[1]) <= len(own), f"{match[0]}, but there are {len(own)} sidecars"
    assert "Traceback" not in trial.stderr, trial.stderr


def check_end(trial: Trial, reference: dict[str, bytes]) -> None:
    """Resume, and check that the output equals that of an undisturbed run."""
    assert trial.run() == 0, f"resuming failed: {trial.stderr[-600:]}"
    made = files(trial.out)
    for what, names in (
        ("missing", reference.keys() - made.keys()),
        ("not removed", made.keys() - reference.keys()),
        ("different", {n for n in reference.keys() & made.keys() if made[n] != reference[n]}),
    ):
        assert not names, f"{what}: {sorted(names)[:5]}"
    for name, data in FOREIGN.items():
        assert (trial.out / name).read_bytes() == data, f"{name} was changed"
    log = (trial.out / "run.jsonl").read_text("utf-8")
    for line in log[log.rindex('{"event": "start"') :].splitlines():
        json.loads(line)


def prepare(folder: Path, count: int) -> None:
    """Write the inputs, and compile faults.c."""
    pixels = np.random.default_rng(0).random((24, 32, 3)).astype(np.float32)
    for number in range(count):
        path = folder / "in" / ("sub" if number % 3 else ".") / f"r{number:03}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, pixels * (number + 1) / count, "RGB", {}, half=True)
    source = Path(__file__).with_suffix(".c")
    command = [
        "cc",
        "-O2",
        "-shared",
        "-fPIC",
        "-o",
        str(folder / "faults.so"),
        str(source),
        "-ldl",
    ]
    subprocess.run(command, check=True)


def main() -> int:
    """Run the trials of each fault, and print the results."""
    parser = parser_of(__doc__)
    parser.add_argument("--images", type=count_of, default=200, help="in a batch [200]")
    parser.add_argument("--repeats", type=count_of, default=50, help="trials of each fault [50]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments [0]")
    parser.add_argument("--device", default="0", help="like clpipe's --device [0]")
    parser.add_argument("faults", nargs="*", metavar="FAULT", help="all by default")
    options = parser.parse_args()
    if unknown := {*options.faults} - {*FAULTS}:
        parser.error(f"found {min(unknown)}; the faults are {', '.join(FAULTS)}")
    bad = 0
    with tempfile.TemporaryDirectory(prefix="clpipe-faults-") as name:
        folder = Path(name).resolve()
        prepare(folder, options.images)
        references = {}
        for output in KINDS:
            trial = Trial(folder / output, output, options.device, random.Random(0))
            assert trial.run() == 0, trial.stderr
            references[output] = files(trial.out)
        for fault in options.faults or FAULTS:
            for number in range(options.repeats):
                output = list(KINDS)[number % len(KINDS)]
                rng = random.Random(f"{options.seed} {fault} {number}")
                trial = Trial(folder / f"{fault}{number}", output, options.device, rng)
                reference = references[output]
                try:
                    trial.run_with_fault(fault, sum(map(len, reference.values())))
                    check_claims(trial, reference)
                    check_end(trial, reference)
                except (AssertionError, OSError, subprocess.SubprocessError) as error:
                    bad += 1
                    print(f"{fault} {number} ({output}): {error}", flush=True)
                shutil.rmtree(trial.place)
            print(f"{fault}: {options.repeats} trials", flush=True)
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
