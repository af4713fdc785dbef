"""Interrupt batches with faults, resume them, and compare all files with an undisturbed run.

    tools/run stress faults [--images N] [--repeats N] [--seed N] [--device SEL] [FAULT...]

Each trial has a new output directory, and its fault occurs at a random moment. A batch writes
pictures of three kinds with sidecars, or tars. Every image that the summary counts as done must
exist. Then the same command resumes. It must write every file of the undisturbed run, byte for
byte, leave no temporary files, and change no foreign files. The exit status is 1 after any failure.
The tool needs a C compiler.
"""

import argparse
import contextlib
import functools
import json
import os
import random
import re
import resource
import runpy
import shutil
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tools import ROOT

FOREIGN = {
    "notes.txt": b"not clpipe's",
    "pictures/other.jpg": b"\xff\xd8 somebody's",
    "z.json": b"{}",
}
KINDS = {
    "folder": ("--keep", "normalize", "--truth", "mosaic"),
    "tars": ("--webdataset", "7"),
}
LIMIT = 600  # s, for one run


class Trial:
    """A batch with its own output directory, disturbed once and then resumed."""

    def __init__(self, place: Path, output: str, device: str, rng: random.Random) -> None:
        self.place = place
        self.rng = rng
        self.out = place / "out"
        self.log = place / "operations"
        self.out.mkdir(parents=True)
        for name, data in FOREIGN.items():
            (self.out / name).parent.mkdir(exist_ok=True)
            (self.out / name).write_bytes(data)
        self.arguments = ["run", "in", "-o", str(self.out), "--device", device, *KINDS[output]]
        self.stderr = ""
        self.edited = ""  # the edited file, if there is one
        self.is_other = False  # whether another program wrote the files
        self.limit: Callable[[], None] | None = None  # called in the child before it starts

    def command(self, driver: str = "") -> list[str]:
        """Return the command line; ``driver`` names the part of the program that is patched."""
        start = ["-m", "tools.stress.faults", "--driver", driver] if driver else ["-m", "clpipe"]
        return [sys.executable, *start, *self.arguments]

    def start(self, driver: str = "", **environment: str) -> subprocess.Popen:
        """Start the run in the folder of the inputs."""
        return subprocess.Popen(
            self.command(driver),
            cwd=self.place.parent,
            env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=self.limit,  # noqa: PLW1509 - this program has no threads
        )

    def run(self, driver: str = "", **environment: str) -> int:
        """Run to the end, set ``stderr``, and return the exit status."""
        process = self.start(driver, **environment)
        try:
            _, self.stderr = process.communicate(timeout=LIMIT)
        except subprocess.TimeoutExpired:
            process.kill()
            raise AssertionError(f"the run hung for {LIMIT} s") from None
        return process.returncode

    def run_with_fault(self, kind: str, size: int) -> int:
        """Run with a fault at a random one of ``size`` bytes, and return the exit status."""
        at = self.rng.randrange(size)
        return self.run(
            LD_PRELOAD=str(self.place.parent / "faults.so"),
            FAULTS_DIR=str(self.out),
            FAULTS_KIND=kind,
            FAULTS_AT=str(at),
            FAULTS_LOG=str(self.log),
        )


def files(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder, except logs and foreign files."""
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {n: p.read_bytes() for n, p in found.items() if n != "run.jsonl" and n not in FOREIGN}


def check_claims(trial: Trial, reference: dict[str, bytes]) -> None:
    """Check that images that the summary counts as done exist and are correct."""
    made = files(trial.out)
    for name, data in made.items():
        is_temporary = ".part" in name or name.startswith(".clpipe")
        # Tars of an unfinished run may have other members.
        if trial.is_other or is_temporary or name.endswith(".tar"):
            continue
        if name != trial.edited:
            assert name in reference, f"wrote {name}, which the undisturbed run does not write"
            assert data == reference[name], f"{name} is damaged under its final name"
    match = re.search(r"(\d+) of \d+ images? done", trial.stderr)
    if match and "tar" not in "".join(reference):
        sidecars = [
            n for n in made if n.endswith(".json") and ".truth" not in n and ".part" not in n
        ]
        assert int(match[1]) <= len(sidecars), (
            f"the summary says {match[0]}, but there are {len(sidecars)} sidecars"
        )
    assert "Traceback" not in trial.stderr, trial.stderr


def check_end(trial: Trial, reference: dict[str, bytes]) -> None:
    """Resume, and check that the output equals that of an undisturbed run."""
    assert trial.run() == 0, f"resuming failed: {trial.stderr[-600:]}"
    made = files(trial.out)
    missing, extra = sorted(reference.keys() - made.keys()), sorted(made.keys() - reference.keys())
    assert not missing, f"missing: {missing[:5]}"
    assert not extra, f"not removed: {extra[:5]}"
    wrong = [name for name, data in reference.items() if made[name] != data]
    assert not wrong, f"different: {wrong[:5]}"
    for name, data in FOREIGN.items():
        assert (trial.out / name).read_bytes() == data, f"{name} was changed"
    log = (trial.out / "run.jsonl").read_text("utf-8")
    for line in log[log.rindex('{"event": "start"') :].splitlines():
        json.loads(line)


def kill(trial: Trial, seconds: float, total: int) -> None:
    """Send SIGKILL at a random moment."""
    process = trial.start()
    time.sleep(trial.rng.uniform(0.3, 1.1) * seconds)
    process.send_signal(signal.SIGKILL)
    _, trial.stderr = process.communicate()


def stop(trial: Trial, seconds: float, total: int) -> None:
    """Send SIGTERM, like schedulers."""
    process = trial.start()
    time.sleep(trial.rng.uniform(0.3, 1.1) * seconds)
    process.send_signal(signal.SIGTERM)
    _, trial.stderr = process.communicate(timeout=LIMIT)


def fault(kind: str, trial: Trial, seconds: float, total: int) -> None:
    """Fault at a random byte: a full disk, a failed write or a short write."""
    status = trial.run_with_fault(kind, total)
    assert status in (0, 1, 2), f"ended with {status}: {trial.stderr[-400:]}"
    assert status == 0 or kind != "short", f"a short write is not an error: {trial.stderr[-400:]}"


def without_power(trial: Trial, seconds: float, total: int) -> None:
    """Power failure at a random byte: writes and renames since the last fsync are lost."""
    trial.run_with_fault("kill", total)
    unsynced: set[str] = set()
    renamed: dict[str, str] = {}
    for line in trial.log.read_text("utf-8", "surrogateescape").splitlines():
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
    for path in unsynced:
        if os.path.exists(path):
            size = os.path.getsize(path)
            os.truncate(path, trial.rng.randrange(size + 1))
            if trial.rng.random() < 0.5:  # its blocks were allocated but not written
                os.truncate(path, 0)
                os.truncate(path, size)
    for to, name in renamed.items():
        if os.path.exists(to) and trial.rng.random() < 0.5:
            os.rename(to, name)
    for path in trial.out.rglob("*.json*"):  # a log may end in zeros, a sidecar must not
        assert path.name == "run.jsonl" or ".part." in path.name or path.read_bytes().strip(b"\0")


def driven(driver: str, trial: Trial, seconds: float, total: int) -> None:
    """Make a part of the program fail once."""
    status = trial.run(driver, FAULTS_COUNT=str(trial.rng.randrange(1, 20)))
    assert status in (0, 1), f"ended with {status}: {trial.stderr[-400:]}"


def two_at_once(trial: Trial, seconds: float, total: int) -> None:
    """Two runs write into one directory: the second is rejected, or finds all images done."""
    both = [trial.start()]
    time.sleep(trial.rng.uniform(0, 0.5) * seconds)
    both.append(trial.start())
    errors = [process.communicate(timeout=LIMIT)[1] for process in both]
    statuses = sorted(process.returncode for process in both)
    assert statuses in ([0, 0], [0, 2]), f"{statuses}: {errors}"
    trial.stderr = errors[0] if both[0].returncode == 0 else errors[1]


def edited(trial: Trial, seconds: float, total: int) -> None:
    """Edit a sidecar of a finished batch; commands that read it must not show a traceback."""
    assert trial.run() == 0, trial.stderr
    rng = trial.rng
    own = [path for path in trial.out.rglob("*.json") if path.name not in FOREIGN]
    place = rng.choice(sorted(own or trial.out.rglob("*.tar")))
    data, start = place.read_bytes(), 0
    size = len(data)
    if not own:
        with tarfile.open(place) as tar:
            member = rng.choice([each for each in tar if each.name.endswith(".json")])
        start, size = member.offset_data, member.size
    text = data[start : start + size]
    at = rng.randrange(size)
    edits = [
        text[:at] + bytes([text[at] ^ 1 << rng.randrange(8)]) + text[at + 1 :],
        (text[:at] + rng.randbytes(20) + text[at + 20 :])[:size],
        text[:at] + bytes(size - at),
        text[:at] + text[at:].translate(bytes.maketrans(b"0123456789", b"1234567890")),
        text[:at] + text[at:][::-1],
    ]
    if own:  # offsets of a tar's members would change
        edits += [text[:at], text[:at] + rng.randbytes(20) + text[at:], text.replace(b": ", b":")]
    place.write_bytes(data[:start] + rng.choice(edits) + data[start + size :])
    trial.edited = place.relative_to(trial.out).as_posix()
    for command in (["poses", trial.out], ["replay", place, "-o", trial.place / "again"]):
        result = subprocess.run(
            [sys.executable, "-m", "clpipe", *command],
            cwd=trial.place.parent,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            check=False,
        )
        assert result.returncode in (0, 2), (
            f"ended with {result.returncode}: {result.stderr[-400:]}"
        )
        assert "Traceback" not in result.stderr, result.stderr


def with_damaged_cache(trial: Trial, seconds: float, total: int) -> None:
    """Truncate, empty or change cached kernels, verdicts and program files at random."""
    rng, cache = trial.rng, trial.place.parent / "cache"  # shared by all trials of this fault
    if not cache.exists():
        assert trial.run(CLPIPE_CACHE_DIR=str(cache)) == 0, trial.stderr
        shutil.rmtree(trial.out)
        trial.out.mkdir()
        for name, data in FOREIGN.items():
            (trial.out / name).parent.mkdir(exist_ok=True)
            (trial.out / name).write_bytes(data)
    cached = sorted(p for p in cache.rglob("*") if p.is_file() and p.stat().st_size)
    for path in rng.sample(cached, rng.randint(1, len(cached))):
        data = bytearray(path.read_bytes())
        at = rng.randrange(len(data))
        data[at] ^= 1 << rng.randrange(8)
        path.write_bytes(rng.choice([data, data[:at], data[:at] + rng.randbytes(9), b""]))
    status = trial.run(CLPIPE_CACHE_DIR=str(cache))
    assert status == 0, f"ended with {status}: {trial.stderr[-400:]}"
    messages = [line for line in trial.stderr.splitlines() if line.startswith("clpipe: ")]
    assert len(messages) <= 1, messages


def by_another_program(trial: Trial, seconds: float, total: int) -> None:
    """A program with another quantizer starts the batch, may be killed, and clpipe resumes."""
    other = trial.place / "program"
    for folder in ("clpipe", "kernels"):
        shutil.copytree(ROOT / folder, other / folder)
    for name, was, now in (
        ("kernels/quantize.cl", "+ black_level)", "+ black_level + 9.0f)"),
        ("clpipe/stages/quantize.py", '+ n["black_level"])', '+ n["black_level"] + 9)'),
    ):
        text = (other / name).read_text("utf-8")
        assert text.count(was) == 1, name
        (other / name).write_text(text.replace(was, now), "utf-8")
    trial.is_other = True
    process = trial.start(PYTHONPATH=str(other))
    if trial.rng.random() < 0.5:
        time.sleep(trial.rng.uniform(0.5, 1.2) * seconds)
        process.kill()
    _, trial.stderr = process.communicate(timeout=LIMIT)


def short_of_memory(trial: Trial, seconds: float, total: int) -> None:
    """Limit the memory by a control group or the address space, and add a large image."""
    size = trial.rng.randrange(130, 1300) << 20
    group = memory_group(size) if trial.rng.random() < 0.5 else None

    def limit() -> None:
        if group:
            (group / "cgroup.procs").write_text(str(os.getpid()))
        else:
            resource.setrlimit(resource.RLIMIT_AS, (size, size))

    large, made = trial.place.parent / "large.exr", trial.place.parent / "large"
    is_folder = "--webdataset" not in trial.arguments  # tars would change with another image
    if is_folder and not made.exists():
        from clpipe.images.write import write_exr

        write_exr(large, np.full((4000, 6000, 3), 0.2, np.float32), "RGB", {}, half=True)
        single = Trial(made, "folder", "", trial.rng)
        single.arguments = [str(large) if x == "in" else x for x in trial.arguments]
        single.arguments[single.arguments.index("-o") + 1] = str(single.out)
        assert single.run() == 0, single.stderr
    if is_folder:
        trial.arguments.insert(2, str(large))
    trial.limit = limit
    status = trial.run()
    trial.limit = None
    if group:
        group.rmdir()
    assert status in (0, 1, 3), f"in {size >> 20} MiB it ended with {status}: {trial.stderr[-400:]}"
    if is_folder:
        trial.arguments.remove(str(large))
        of_large = {path for path in trial.out.rglob("large.*") if ".part" not in path.name}
        if status == 0 or of_large:
            expected = {p.name: p.read_bytes() for p in (made / "out").rglob("large.*")}
            found = {p.name: p.read_bytes() for p in of_large}
            assert found == expected, f"files of the large image: {sorted(found)}"
        elif status == 1:
            assert re.search(r"large\.exr: it takes about .* is available", trial.stderr), (
                trial.stderr
            )
        for path in of_large:
            path.unlink()


def memory_group(size: int) -> Path | None:
    """Create a control group with a memory limit; return None if this is not possible."""
    from clpipe.base.control_groups import group_folders

    for parent, is_first_version in group_folders("memory", Path("/")):
        group = parent / f"clpipe-faults-{os.getpid()}"
        name = "memory.limit_in_bytes" if is_first_version else "memory.max"
        try:
            group.mkdir()
            (group / name).write_text(str(size))
        except OSError:
            with contextlib.suppress(OSError):
                group.rmdir()
            continue
        return group
    return None


FAULTS: dict[str, Callable[[Trial, float, int], None]] = {
    "kill": kill,
    "stop": stop,
    "full": functools.partial(fault, "full"),
    "eio": functools.partial(fault, "eio"),
    "short": functools.partial(fault, "short"),
    "power": without_power,
    "device": functools.partial(driven, "device"),
    "decoder": functools.partial(driven, "decoder"),
    "clock": functools.partial(driven, "clock"),
    "two": two_at_once,
    "edit": edited,
    "cache": with_damaged_cache,
    "program": by_another_program,
    "memory": short_of_memory,
}


def drive(name: str, arguments: list[str]) -> None:
    """Run the program with a part that fails once, or with a clock that jumps."""
    left = int(os.environ["FAULTS_COUNT"])

    def failing(real: Callable, error: Exception) -> Callable:
        def call(*args: object, **kwargs: object) -> object:
            nonlocal left
            left -= 1
            if left == 0:
                raise error
            return real(*args, **kwargs)

        return call

    if name == "device":
        import pyopencl as cl

        from clpipe.engine import runner

        lost = cl.RuntimeError("clEnqueue failed: OUT_OF_RESOURCES", -5, "clEnqueue")
        cl.enqueue_nd_range_kernel = failing(cl.enqueue_nd_range_kernel, lost)
        runner.Runner._run_numpy = failing(runner.Runner._run_numpy, MemoryError())
    elif name == "decoder":
        from clpipe.inputs.loader import ImageLoader

        ImageLoader.read = failing(ImageLoader.read, ZeroDivisionError("of a decoder"))
    else:
        real = time.time
        rng = random.Random(left)
        time.time = lambda: real() + rng.choice((-1e8, -3600, 0, 3600, 1e8))
    sys.argv = ["clpipe", *arguments]
    runpy.run_module("clpipe", run_name="__main__")


def prepare(folder: Path, count: int) -> None:
    """Write the inputs, and compile faults.c."""
    from clpipe.images.write import write_exr

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
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--images", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="0")
    parser.add_argument(
        "faults", nargs="*", metavar="FAULT", help=f"the choices are {', '.join(FAULTS)}"
    )
    options = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory(prefix="clpipe-faults-") as name:
        folder = Path(name).resolve()
        prepare(folder, options.images)
        references, seconds = {}, {}
        for output in KINDS:
            trial = Trial(folder / output, output, options.device, random.Random(0))
            assert trial.run() == 0, trial.stderr
            references[output] = files(trial.out)
            shutil.rmtree(trial.out)
            trial.out.mkdir()
            began = time.perf_counter()
            assert trial.run() == 0, trial.stderr
            seconds[output] = time.perf_counter() - began
            assert files(trial.out) == references[output], "two undisturbed runs differ"
        for fault_ in options.faults or FAULTS:
            counts: Counter[str] = Counter()
            for number in range(options.repeats):
                output = list(KINDS)[number % len(KINDS)]
                rng = random.Random(f"{options.seed} {fault_} {number}")
                trial = Trial(folder / f"{fault_}{number}", output, options.device, rng)
                try:
                    FAULTS[fault_](
                        trial, seconds[output], sum(map(len, references[output].values()))
                    )
                    done = len(files(trial.out)) / len(references[output])
                    check_claims(trial, references[output])
                    check_end(trial, references[output])
                    counts["none" if not done else "all" if done >= 1 else "some"] += 1
                except (AssertionError, OSError, subprocess.SubprocessError) as error:
                    bad += 1
                    print(f"{fault_} {number} ({output}): {error}", flush=True)
                shutil.rmtree(trial.place)
            states = ", ".join(f"{n} {state}" for state, n in sorted(counts.items()))
            print(
                f"{fault_}: {options.repeats} trials; files after the fault: {states}", flush=True
            )
    return bool(bad)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--driver"]:
        drive(sys.argv[2], sys.argv[3:])
    else:
        sys.exit(main())
