"""A run with several processes: the same bytes, even if a process dies."""

import errno
import itertools
import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from loky import ProcessPoolExecutor

import clpipe as package
from clpipe.base.errors import DeviceError, RequestError
from clpipe.base.processors import available_processors
from clpipe.base.system import processor_numbers
from clpipe.batch import processes
from clpipe.batch.run_log import read_log
from tests.conftest import contents, run_python, statuses, written
from tests.held import (
    GO,
    HOLDING_PROCESSES,
    before,
    finish,
    interrupt,
    plant,
    start,
    wait_until,
)

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _planted_nothing(monkeypatch):
    monkeypatch.setattr(processes, "prepare", processes.prepare)  # restored after plant()


RUN = ("-o", "out", "--iso", 3200)
TWO = (*RUN, "--processes", 2)
DEADLY = "given[1].path.name == 'deadly.exr' and os.kill(os.getpid(), 9)"


def pictures():
    return len(list(Path("out").glob("r*.json")))


def held_run():
    """A run by two processes that both wait at a held image, and their process IDs."""
    process = start("in", *TWO, planted=HOLDING_PROCESSES)
    wait_until(lambda: len(held()) == 2, "two processes that hold", process)
    return process, held()


def held():
    """Return the IDs of processes that wait at a held image."""
    return sorted(int(path.suffix[1:]) for path in Path().glob("held.*"))


# Images after r000 wait until both processes have one. The processes note their processors.
BOTH = """pathlib.Path(f"begun.{os.getpid()}").write_text(json.dumps([*os.sched_getaffinity(0)]))
    while given[1].path.stem > "r000" and len([*pathlib.Path().glob("begun.*")]) < 2:
        time.sleep(0.01)"""


def test_two_processes_make_the_bytes_of_one(clpipe, renders):
    renders(24)
    plant(before("begin", BOTH))
    Path("in/damaged.exr").write_bytes(b"no EXR")
    truth = ("--truth", "clean", "--trace", "t.json")
    clpipe("run", "in", "-o", "whole", *RUN[2:], *truth[:2], status=1)
    result = clpipe("run", "in", *TWO, *truth, status=1)
    assert contents("out") == contents("whole")
    assert result.stderr.count("in/damaged.exr: cannot be read") == 1
    assert "24 of 25 images done, 1 failed" in result.stderr
    first, *images, last = read_log(Path("out/run.jsonl"))
    assert (first["event"], len(images), last["event"]) == ("start", 25, "end")
    events = json.loads(Path("t.json").read_text())["traceEvents"]
    assert {e["args"]["name"].split()[0] for e in events if e["ph"] == "M"} == {"0", "1"}
    available = processor_numbers()
    if 1 < len(available) == available_processors():
        bound = [json.loads(path.read_text()) for path in Path().glob("begun.*")]
        assert sorted(number for numbers in bound for number in numbers) == available
    again = clpipe("run", "in", *TWO, *truth[:2], status=1)
    assert "24 of them were there already" in again.stderr


def test_a_process_that_is_killed_takes_nothing_with_it(clpipe, renders):
    renders(30)
    clpipe("run", "in", "-o", "whole", *RUN[2:])
    process, others = held_run()
    os.kill(others[0], signal.SIGKILL)
    Path(GO).touch()
    assert "30 of 30 images done" in finish(process)
    assert process.returncode == 0
    assert contents("out") == contents("whole")
    assert not [name for name in written(Path("out")) if ".part." in name]


@pytest.mark.parametrize("end", ["killed", "a second signal"])
def test_processes_end_with_the_one_that_started_them(clpipe, renders, end):
    renders(30)
    process, _ = held_run()
    if end == "killed":
        process.kill()
    else:
        interrupt(process)
        process.send_signal(signal.SIGTERM)
    printed = finish(process)  # by all processes, until the last one has ended
    assert [line for line in printed.splitlines() if not line.startswith("in/")] == []
    assert not semaphores(process.pid)
    assert pictures() <= 20
    result = clpipe("run", "in", *RUN)
    assert "30 of 30 images done (" in result.stderr


def test_processes_end_while_they_start(renders):
    renders(4)
    ending = "import os\nfrom clpipe.batch import processes\n"
    ending += "processes.Processes._outcomes = lambda *arguments: os._exit(9)"
    process = start("in", *TWO, planted=ending)
    assert finish(process) == ""  # until the last process has ended
    assert process.returncode == 9
    assert not semaphores(process.pid)


def semaphores(pid):
    """Return the files of the semaphores that a process has created."""
    return list(Path("/dev/shm").glob(f"sem.loky-{pid}-*"))


def test_stopped_once_what_is_begun_is_finished(renders):
    renders(60)
    process, _ = held_run()
    interrupt(process)
    Path(GO).touch()
    assert "not begun" in finish(process)
    assert process.returncode == 130
    found = written(Path("out"))
    assert 2 * (20 + 2) <= len(found) < 120
    assert {Path(n).stem for n in found if n.endswith("json")} == {
        Path(n).stem for n in found if n.endswith("jpg")
    }
    last = read_log(Path("out/run.jsonl"))[-1]
    assert last["interrupted"]
    assert last["done"] == len(found) // 2


def test_an_image_that_kills_processes_fails_alone(clpipe, renders):
    renders(9)
    Path("in/r005.exr").rename("in/deadly.exr")
    plant(before("begin", DEADLY))
    result = clpipe("run", "in", *TWO, "--device", "numpy", status=1)
    assert "in/deadly.exr: killed the process that took it, 2 times; the last one by signal 9" in (
        result.stderr
    )
    assert "8 of 9 images done, 1 failed" in result.stderr
    found = statuses("out")
    assert [name for name, status in found.items() if status == "failed"] == ["deadly.exr"]


def test_processes_that_end_as_they_start(renders):
    renders(3)
    plant("import os; os._exit(7)")
    run = package.run("in", "out", processes=2)
    with pytest.raises(DeviceError, match=r"3 processes in a row ended before .* with status 7"):
        list(run)


def test_errors_of_a_process_are_the_runs(renders):
    renders(3)
    run = package.run("in", "out", processes=2, device="no such device")
    with pytest.raises(DeviceError, match="no such device"):
        list(run)
    with pytest.raises(RequestError, match="processes: a tar is packed by one process"):
        package.run("in", "out", processes=2, webdataset=2)
    with pytest.raises(RequestError, match="processes: with dask the cluster"):
        package.run("in", "out", processes=2, dask="tcp://127.0.0.1:1")


def test_whoever_stops_listening_leaves_no_process(renders):
    renders(40)
    run = iter(package.run("in", "out", processes=2, device="numpy"))
    first = next(run)
    assert first.status == "done"
    run.close()
    with pytest.raises(ProcessLookupError):
        os.kill(first.pid, 0)
    assert not semaphores(os.getpid())
    assert not (Path("out") / ".part").exists()
    assert pictures() < 40


SCRIPT = """
import clpipe
from tests.held import before, plant
interrupted = "import os; os.kill(os.getpid(), 2)"
plant(interrupted + before("compile", "print('noise', flush=True)"))
print(*(outcome.status for outcome in clpipe.run("in", "out", processes=2, device="numpy")))
"""


def test_a_script_needs_no_guard_and_stdout_is_its_own(renders):
    renders(3)
    Path("script.py").write_text(SCRIPT)
    done = run_python("script.py")
    assert (done.stdout, {*done.stderr.split()}) == ("done done done\n", {"noise"})


BROKEN = "time.sleep(0.3); raise DeviceError('a kernel does not compile')"


@pytest.mark.parametrize("side", [24, 1700])
def test_a_kernel_that_does_not_compile_ends_the_run(write_exr, clpipe, side):
    """The run also ends if all images are distributed and decoders wait."""
    for i in range(2):
        write_exr(f"in/r{i}.exr", np.zeros((side, side, 3), np.float32))
    plant(before("compile", BROKEN))
    stderr = clpipe("run", "in", *TWO, "--device", "numpy", status=3).stderr
    assert "a kernel does not compile" in stderr


def test_processes_that_all_die_end_the_run(renders, monkeypatch):
    renders(20)
    plant(before("begin", "os._exit(9)"))
    monkeypatch.setitem(processes.MAX_DEATHS, processes.MADE, 4)
    with pytest.raises(DeviceError, match=r"4 processes in a row ended before .* with status 9"):
        list(package.run("in", "out", processes=2, device="numpy"))


def test_nothing_runs_from_the_working_directory_and_nothing_is_left(renders, tmp_path, clpipe):
    renders(4)
    for name in ("json", "signal", "loky", "argparse", "multiprocessing"):
        Path(f"{name}.py").write_text("raise SystemExit('not yours')\n")
    place = tmp_path / "temporary"
    (place / "bin").mkdir(parents=True)
    program = place / "bin" / "program.py"
    program.write_text("from clpipe.__main__ import main\nmain()\n")
    done = run_python(program, "run", "in", *TWO, "--device", "numpy", "--quiet", TMPDIR=place)
    assert done.stdout == done.stderr == ""
    assert pictures() == 4
    program.unlink()
    assert not [path for path in place.rglob("*") if path.is_file()]


def test_fewer_processes_where_the_system_gives_no_more(renders, monkeypatch):
    renders(6)
    pools = itertools.count()

    def limited(*arguments, **options):
        if next(pools):
            raise OSError(errno.EAGAIN, "no more processes")
        return ProcessPoolExecutor(*arguments, **options)

    monkeypatch.setattr("loky.ProcessPoolExecutor", limited)
    run = package.run("in", "out", processes=3, device="numpy")
    assert [outcome.status for outcome in run] == ["done"] * 6
    with pytest.raises(RequestError, match=r"2: no process can be started \(no more processes\)"):
        list(package.run("in", "other", processes=2, device="numpy"))


def test_a_process_that_dies_while_it_waits_is_replaced(renders):
    renders(30)
    run = package.run("in", "out", processes=2, device="numpy")
    begun = iter(run)
    os.kill(next(begun).pid, signal.SIGKILL)  # nobody has given it more than the first image
    time.sleep(1)
    assert sorted(outcome.status for outcome in begun) == ["done"] * 29


def test_log_lines_of_processes_appear_once(renders, caplog):
    renders(20)
    plant(before("begin", "logging.getLogger('clpipe.batch').warning('at work')"))
    with caplog.at_level("INFO"):
        list(package.run("in", "out", processes=2, device="numpy"))
    assert [r.levelname for r in caplog.records if r.getMessage() == "at work"] == ["WARNING"]
