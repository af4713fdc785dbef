"""Run batches under bad luck, go on with each, and compare all files with an undisturbed run's.

    tools/run stress faults [--images N] [--repeats N] [--seed N] [--device SEL] [FAULT...]

Each fault strikes a batch at a random moment, in a new output folder each time: pictures of three
kinds with sidecars, or tars. What the summary called done must be there; then the same command goes
on, and must make every file as the undisturbed run did, byte for byte, leave none of its own
behind, and touch none of others. The exit status is 1 if anything was wrong. Needs a C compiler.
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
WAYS = {
    "folder": ("--keep", "normalize", "--truth", "mosaic"),
    "tars": ("--webdataset", "7"),
}
LIMIT = 600  # s, for one run


class Trial:
    """One batch in an output folder of its own, struck once and then continued."""

    def __init__(self, place: Path, way: str, device: str, luck: random.Random) -> None:
        self.place = place
        self.luck = luck
        self.out = place / "out"
        self.log = place / "operations"
        self.out.mkdir(parents=True)
        for name, data in FOREIGN.items():
            (self.out / name).parent.mkdir(exist_ok=True)
            (self.out / name).write_bytes(data)
        self.arguments = ["run", "in", "-o", str(self.out), "--device", device, *WAYS[way]]
        self.said = ""
        self.edited = ""  # the file that was edited, if one was
        self.is_other = False  # whether another program has made what is there
        self.limit: Callable[[], None] | None = None  # is called in the process before it runs

    def command(self, driver: str = "") -> list[str]:
        """The command line; ``driver`` is the name of what is patched in the program."""
        start = ["-m", "tools.stress.faults", "--driver", driver] if driver else ["-m", "clpipe"]
        return [sys.executable, *start, *self.arguments]

    def start(self, driver: str = "", **environment: str) -> subprocess.Popen:
        """Start the run, in the folder of the inputs."""
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
        """Run it to its end; its exit status. What it prints is in ``said``."""
        process = self.start(driver, **environment)
        try:
            _, self.said = process.communicate(timeout=LIMIT)
        except subprocess.TimeoutExpired:
            process.kill()
            raise AssertionError(f"it hung for {LIMIT} s") from None
        return process.returncode

    def struck(self, kind: str, whole: int) -> int:
        """Run with a fault after a random number of the bytes that a whole run writes."""
        at = self.luck.randrange(whole)
        return self.run(
            LD_PRELOAD=str(self.place.parent / "faults.so"),
            FAULTS_DIR=str(self.out),
            FAULTS_KIND=kind,
            FAULTS_AT=str(at),
            FAULTS_LOG=str(self.log),
        )


def files(folder: Path) -> dict[str, bytes]:
    """All files below a folder, but for logs and what was there before."""
    found = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {n: p.read_bytes() for n, p in found.items() if n != "run.jsonl" and n not in FOREIGN}


def check_claims(trial: Trial, reference: dict[str, bytes]) -> None:
    """See that what the summary calls done is there and right."""
    made = files(trial.out)
    for name, data in made.items():
        is_temporary = ".part" in name or name.startswith(".clpipe")
        # Of tars that are not complete the content differs; each must be a whole tar.
        if trial.is_other or is_temporary or name.endswith(".tar"):
            continue
        if name != trial.edited:
            assert name in reference, f"made {name}, which no undisturbed run makes"
            assert data == reference[name], f"{name} is damaged under its final name"
    match = re.search(r"(\d+) of \d+ images? done", trial.said)
    if match and "tar" not in "".join(reference):
        sidecars = [
            n for n in made if n.endswith(".json") and ".truth" not in n and ".part" not in n
        ]
        assert int(match[1]) <= len(sidecars), (
            f"says {match[0]}; {len(sidecars)} sidecars are there"
        )
    assert "Traceback" not in trial.said, trial.said


def check_end(trial: Trial, reference: dict[str, bytes]) -> None:
    """Go on, and see that the output is that of an undisturbed run."""
    assert trial.run() == 0, f"going on failed: {trial.said[-600:]}"
    made = files(trial.out)
    missing, more = sorted(reference.keys() - made.keys()), sorted(made.keys() - reference.keys())
    assert not missing, f"missing: {missing[:5]}"
    assert not more, f"left behind: {more[:5]}"
    wrong = [name for name, data in reference.items() if made[name] != data]
    assert not wrong, f"different: {wrong[:5]}"
    for name, data in FOREIGN.items():
        assert (trial.out / name).read_bytes() == data, f"{name} was touched"
    log = (trial.out / "run.jsonl").read_text("utf-8")
    for line in log[log.rindex('{"event": "start"') :].splitlines():
        json.loads(line)


def killed(trial: Trial, seconds: float, whole: int) -> None:
    """SIGKILL at a random moment."""
    process = trial.start()
    time.sleep(trial.luck.uniform(0.3, 1.1) * seconds)
    process.send_signal(signal.SIGKILL)
    _, trial.said = process.communicate()


def stopped(trial: Trial, seconds: float, whole: int) -> None:
    """SIGTERM, as schedulers send it."""
    process = trial.start()
    time.sleep(trial.luck.uniform(0.3, 1.1) * seconds)
    process.send_signal(signal.SIGTERM)
    _, trial.said = process.communicate(timeout=LIMIT)


def fault(kind: str, trial: Trial, seconds: float, whole: int) -> None:
    """A fault at a random byte: the disk is full, a write fails, or takes half."""
    status = trial.struck(kind, whole)
    assert status in (0, 1, 2), f"ended with {status}: {trial.said[-400:]}"
    assert status == 0 or kind != "short", f"a short write is no error: {trial.said[-400:]}"


def without_power(trial: Trial, seconds: float, whole: int) -> None:
    """The power fails at a random byte: writes and renames since the last fsync are lost."""
    trial.struck("kill", whole)
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
            os.truncate(path, trial.luck.randrange(size + 1))
            if trial.luck.random() < 0.5:  # its blocks were allocated, and not written
                os.truncate(path, 0)
                os.truncate(path, size)
    for to, name in renamed.items():
        if os.path.exists(to) and trial.luck.random() < 0.5:
            os.rename(to, name)
    for path in trial.out.rglob("*.json*"):  # a log may end in zeros, a sidecar must not
        assert path.name == "run.jsonl" or ".part." in path.name or path.read_bytes().strip(b"\0")


def driven(driver: str, trial: Trial, seconds: float, whole: int) -> None:
    """Something inside of the program fails once."""
    status = trial.run(driver, FAULTS_COUNT=str(trial.luck.randrange(1, 20)))
    assert status in (0, 1), f"ended with {status}: {trial.said[-400:]}"


def two_at_once(trial: Trial, seconds: float, whole: int) -> None:
    """Two runs into one folder: one of them is refused, or finds all done."""
    both = [trial.start()]
    time.sleep(trial.luck.uniform(0, 0.5) * seconds)
    both.append(trial.start())
    said = [process.communicate(timeout=LIMIT)[1] for process in both]
    statuses = sorted(process.returncode for process in both)
    assert statuses in ([0, 0], [0, 2]), f"{statuses}: {said}"
    trial.said = said[0] if both[0].returncode == 0 else said[1]


def edited(trial: Trial, seconds: float, whole: int) -> None:
    """When all is done a sidecar is edited, of which its readers must make no traceback."""
    assert trial.run() == 0, trial.said
    luck = trial.luck
    own = [path for path in trial.out.rglob("*.json") if path.name not in FOREIGN]
    place = luck.choice(sorted(own or trial.out.rglob("*.tar")))
    data, start = place.read_bytes(), 0
    size = len(data)
    if not own:
        with tarfile.open(place) as tar:
            member = luck.choice([each for each in tar if each.name.endswith(".json")])
        start, size = member.offset_data, member.size
    text = data[start : start + size]
    at = luck.randrange(size)
    edits = [
        text[:at] + bytes([text[at] ^ 1 << luck.randrange(8)]) + text[at + 1 :],
        (text[:at] + luck.randbytes(20) + text[at + 20 :])[:size],
        text[:at] + bytes(size - at),
        text[:at] + text[at:].translate(bytes.maketrans(b"0123456789", b"1234567890")),
        text[:at] + text[at:][::-1],
    ]
    if own:  # the places of a tar's members would move
        edits += [text[:at], text[:at] + luck.randbytes(20) + text[at:], text.replace(b": ", b":")]
    place.write_bytes(data[:start] + luck.choice(edits) + data[start + size :])
    trial.edited = place.relative_to(trial.out).as_posix()
    for command in (["poses", trial.out], ["replay", place, "-o", trial.place / "again"]):
        told = subprocess.run(
            [sys.executable, "-m", "clpipe", *command],
            cwd=trial.place.parent,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            check=False,
        )
        assert told.returncode in (0, 2), f"ended with {told.returncode}: {told.stderr[-400:]}"
        assert "Traceback" not in told.stderr, told.stderr


def with_damaged_cache(trial: Trial, seconds: float, whole: int) -> None:
    """What is kept of kernels, verdicts and the program is cut, emptied or changed at random."""
    luck, cache = trial.luck, trial.place.parent / "cache"  # that of all trials of this fault
    if not cache.exists():
        assert trial.run(CLPIPE_CACHE_DIR=str(cache)) == 0, trial.said
        shutil.rmtree(trial.out)
        trial.out.mkdir()
        for name, data in FOREIGN.items():
            (trial.out / name).parent.mkdir(exist_ok=True)
            (trial.out / name).write_bytes(data)
    kept = sorted(p for p in cache.rglob("*") if p.is_file() and p.stat().st_size)
    for path in luck.sample(kept, luck.randint(1, len(kept))):
        data = bytearray(path.read_bytes())
        at = luck.randrange(len(data))
        data[at] ^= 1 << luck.randrange(8)
        path.write_bytes(luck.choice([data, data[:at], data[:at] + luck.randbytes(9), b""]))
    status = trial.run(CLPIPE_CACHE_DIR=str(cache))
    assert status == 0, f"ended with {status}: {trial.said[-400:]}"
    said = [line for line in trial.said.splitlines() if line.startswith("clpipe: ")]
    assert len(said) <= 1, said


def by_another_program(trial: Trial, seconds: float, whole: int) -> None:
    """A program with another quantizer begins, is killed at times, and ours goes on."""
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
    if trial.luck.random() < 0.5:
        time.sleep(trial.luck.uniform(0.5, 1.2) * seconds)
        process.kill()
    _, trial.said = process.communicate(timeout=LIMIT)


def short_of_memory(trial: Trial, seconds: float, whole: int) -> None:
    """Little memory, in a control group or an address space, and a large image among the others."""
    size = trial.luck.randrange(130, 1300) << 20
    group = memory_group(size) if trial.luck.random() < 0.5 else None

    def limit() -> None:
        if group:
            (group / "cgroup.procs").write_text(str(os.getpid()))
        else:
            resource.setrlimit(resource.RLIMIT_AS, (size, size))

    large, made = trial.place.parent / "large.exr", trial.place.parent / "large"
    is_folder = "--webdataset" not in trial.arguments  # another image would change the tars
    if is_folder and not made.exists():
        from clpipe.images.write import write_exr

        write_exr(large, np.full((4000, 6000, 3), 0.2, np.float32), "RGB", {}, half=True)
        alone = Trial(made, "folder", "", trial.luck)
        alone.arguments = [str(large) if x == "in" else x for x in trial.arguments]
        alone.arguments[alone.arguments.index("-o") + 1] = str(alone.out)
        assert alone.run() == 0, alone.said
    if is_folder:
        trial.arguments.insert(2, str(large))
    trial.limit = limit
    status = trial.run()
    trial.limit = None
    if group:
        group.rmdir()
    assert status in (0, 1, 3), f"in {size >> 20} MiB it ended with {status}: {trial.said[-400:]}"
    if is_folder:
        trial.arguments.remove(str(large))
        of_large = {path for path in trial.out.rglob("large.*") if ".part" not in path.name}
        if status == 0 or of_large:
            expected = {p.name: p.read_bytes() for p in (made / "out").rglob("large.*")}
            found = {p.name: p.read_bytes() for p in of_large}
            assert found == expected, f"of the large image there are {sorted(found)}"
        elif status == 1:
            assert re.search(r"large\.exr: it takes about .* are left by", trial.said), trial.said
        for path in of_large:
            path.unlink()


def memory_group(size: int) -> Path | None:
    """A new control group of so much memory; None where none can be made."""
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
    "kill": killed,
    "stop": stopped,
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
    """Run the program with one thing in it that fails once, or a clock that jumps."""
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
        luck = random.Random(left)
        time.time = lambda: real() + luck.choice((-1e8, -3600, 0, 3600, 1e8))
    sys.argv = ["clpipe", *arguments]
    runpy.run_module("clpipe", run_name="__main__")


def prepare(folder: Path, count: int) -> None:
    """Write the inputs and compile the faults."""
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
    """Strike each way of each fault so many times."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--images", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="0")
    parser.add_argument("faults", nargs="*", metavar="FAULT", help=f"of {', '.join(FAULTS)}")
    options = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory(prefix="clpipe-faults-") as name:
        folder = Path(name).resolve()
        prepare(folder, options.images)
        references, seconds = {}, {}
        for way in WAYS:
            trial = Trial(folder / way, way, options.device, random.Random(0))
            assert trial.run() == 0, trial.said
            references[way] = files(trial.out)
            shutil.rmtree(trial.out)
            trial.out.mkdir()
            began = time.perf_counter()
            assert trial.run() == 0, trial.said
            seconds[way] = time.perf_counter() - began
            assert files(trial.out) == references[way], "two undisturbed runs differ"
        for fault_ in options.faults or FAULTS:
            counts: Counter[str] = Counter()
            for number in range(options.repeats):
                way = list(WAYS)[number % len(WAYS)]
                luck = random.Random(f"{options.seed} {fault_} {number}")
                trial = Trial(folder / f"{fault_}{number}", way, options.device, luck)
                try:
                    FAULTS[fault_](trial, seconds[way], sum(map(len, references[way].values())))
                    done = len(files(trial.out)) / len(references[way])
                    check_claims(trial, references[way])
                    check_end(trial, references[way])
                    counts["not begun" if not done else "all" if done >= 1 else "in between"] += 1
                except (AssertionError, OSError, subprocess.SubprocessError) as error:
                    bad += 1
                    print(f"{fault_} {number} ({way}): {error}", flush=True)
                shutil.rmtree(trial.place)
            struck = ", ".join(f"{n} {what}" for what, n in sorted(counts.items()))
            print(f"{fault_}: {options.repeats} times; files then: {struck}", flush=True)
    return bool(bad)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--driver"]:
        drive(sys.argv[2], sys.argv[3:])
    else:
        sys.exit(main())
