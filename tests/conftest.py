import itertools
import json
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import OpenImageIO as oiio
import pyopencl as cl
import pytest
from click.testing import CliRunner
from click.testing import Result as ClickResult

from clpipe.batch.run_log import read_log
from clpipe.batch.sinks import Folder
from clpipe.batch.work import ImageWorker
from clpipe.chain.making import make_chain
from clpipe.chain.request import Request
from clpipe.chain.settings import settings_from
from clpipe.commands.main import main
from clpipe.engine import programs
from clpipe.engine.device import Device
from clpipe.engine.discovery import choose, find_devices
from clpipe.engine.runner import Result, Runner
from clpipe.images.write import write_exr as write_file
from clpipe.inputs.find import Job, find_jobs
from clpipe.inputs.loader import ImageLoader
from clpipe.outputs.shared import with_shared
from clpipe.outputs.sidecar import DIGEST_KEY, sidecar_bytes
from clpipe.outputs.writer import OutputWriter
from clpipe.stage import Kind

ROOT = Path(__file__).resolve().parent.parent
DATA = ROOT / "tests" / "data"
STILL_LIFE = DATA / "still_life.exr"
SHARED = ROOT.parent / "shared" / "data"


def pytest_configure(config: pytest.Config) -> None:
    """Exclude the doctests of clpipe.torch without torch; test_torch.py names what to install."""
    if not find_spec("torch"):
        config.option.ignore_glob = [*config.option.ignore_glob, str(ROOT / "clpipe/torch/*")]


# The time is part of a file's content, from which its noise is seeded.
WRITTEN = "2026:01:01 00:00:00"


def written(folder: Path) -> list[str]:
    """Return the files below a folder, sorted, without the run's log and shared values."""
    found = (p for p in folder.rglob("*") if p.is_file() and p.suffix != ".run")
    return sorted({p.relative_to(folder).as_posix() for p in found} - {"run.jsonl"})


def values_of(sidecar: str | Path) -> dict[str, Any]:
    """Return all values of a sidecar, with those that its run shares."""
    return with_shared(json.loads(Path(sidecar).read_text()), Path(sidecar).parent)


def contents(folder: str | Path) -> dict[str, bytes]:
    """Return the bytes of each file by its name, without the run's log."""
    return {name: (Path(folder) / name).read_bytes() for name in written(Path(folder))}


def stamps(folder: str | Path = "out") -> dict[str, int]:
    """Return when each file was modified, in ns, by its name, without what a run notes."""
    names = [name for name in written(Path(folder)) if not name.startswith("run.")]
    return {name: (Path(folder) / name).stat().st_mtime_ns for name in names}


def statuses(folder: str | Path) -> dict[str, str]:
    """Return the log's outcome of each image in the last run."""
    lines = read_log(Path(folder) / "run.jsonl")
    last = max(i for i, line in enumerate(lines) if line["event"] == "start")
    return {line["name"]: line["status"] for line in lines[last:] if line["event"] == "image"}


def same_samples(one: Mapping[str, Any], two: Mapping[str, Any]) -> None:
    """Check that two samples of a dataset are equal."""
    assert one.keys() == two.keys()
    for name, value in one.items():
        is_float = np.asarray(value).dtype.kind == "f"  # which may be NaN
        assert np.array_equal(value, two[name], equal_nan=is_float), name


def run_cli(*arguments: object, status: int | tuple[int, ...] = 0) -> ClickResult:
    """Run the command line, check its status, and return the result."""
    result = CliRunner().invoke(main, [str(a) for a in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    allowed = status if isinstance(status, tuple) else (status,)
    assert result.exit_code in allowed, result.output
    words = [str(a) for a in arguments]
    if "--json" in words and result.stdout.startswith("{"):
        is_import = words[:2] == ["cameras", "import"]
        check_schema(f"command.{'.'.join(words[: 1 + is_import])}", json.loads(result.stdout))
    if words[0] == "run" and "-o" in words and result.exit_code == 0:
        check_files(Path(words[words.index("-o") + 1]))
    return result


@cache
def validator(name: str) -> jsonschema.protocols.Validator:
    """Return the validator of a schema that allows no other keys."""
    schema = json.loads((ROOT / "clpipe" / "schemas" / f"{name}.json").read_text())
    for each in (schema, *schema.get("$defs", {}).values()):
        if "properties" in each:
            each["additionalProperties"] = False
    return jsonschema.Draft202012Validator(schema)


def check_schema(name: str, values: Any) -> None:
    """Check that values have a schema, and no key that it lacks."""
    error = jsonschema.exceptions.best_match(validator(name).iter_errors(values))
    assert error is None, f"{name}: {error.json_path}: {error.message[:500]}"


def check_files(folder: Path, most: int = 3) -> None:
    """Check the schemas of the first files of each kind that a run has written."""
    kinds = {"run": "*.run", "log": "run*.jsonl", "cameras": "cameras.json", "sidecar": "*.json*"}
    folder = folder.parent if folder.suffix in (".mp4", ".mkv") else folder
    for name, pattern in kinds.items():
        for path in itertools.islice(sorted(folder.rglob(pattern)), most):
            text = path.read_text("utf-8", "surrogateescape")
            lines = [line for line in text.splitlines() if line.endswith("}")][:5]
            for part in lines if path.suffix == ".jsonl" else [text]:
                if part.lstrip("{ \n").startswith('"clpipe"') == (name == "sidecar"):
                    check_schema(name, json.loads(part))


def cli_output(*arguments: object, status: int = 0) -> str:
    """Return the output of the command line."""
    return run_cli(*arguments, status=status).output


def run_python(
    *words: object, cwd: str | Path | None = None, status: int | None = 0, **environment: object
) -> "subprocess.CompletedProcess[str]":
    """Run Python in a process that finds this clpipe, and check its status.

    Args:
        words: what stands behind ``python`` on its command line.
        cwd: its working directory; this one if not given.
        status: the exit status that is expected; any if None.
        environment: variables that it has besides those of this process.
    """
    done = subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=cwd,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            **{k: str(v) for k, v in environment.items()},
        },
        capture_output=True,
        text=True,
    )
    assert status in (done.returncode, None), done.stdout[-2000:] + done.stderr
    return done


def noise_report(*sigmas: float, **changes: Any) -> dict[str, Any]:
    """What clpipe measure --json says of a picture whose R, G, B have these sigmas; with changes.

    Flat places have half of them, and red and green are correlated by 0.5. At an intensity of 0.75
    there is three times the noise of 0.25.
    """
    curve = {"mean": [0.25, 0.75], "samples": [100, 100]}
    channels = {
        name: {
            "sigma": sigma / 2,
            "sigma_picture": sigma,
            "intensity": {**curve, "sigma": [sigma / 2 / 5**0.5, sigma / 2 * 3 / 5**0.5]},
            "intensity_picture": {**curve, "sigma": [sigma / 5**0.5, sigma * 3 / 5**0.5]},
        }
        for name, sigma in zip("RGB", sigmas, strict=True)
    }
    whole = np.outer(sigmas, sigmas) * [[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]]
    places = {"flat": whole / 4, "picture": whole, "halved": whole / 2}
    covariance = {where: table.tolist() for where, table in places.items()}
    report = {"kind": "display", "rounding_variance": 0.0}
    return {**report, "channels": channels, "covariance": covariance, **changes}


def reseal(path: Path, values: Mapping[str, Any]) -> None:
    """Write a sidecar with values of one's own and the digest that fits them, as a forger can."""
    path.write_bytes(
        sidecar_bytes({key: value for key, value in values.items() if key != DIGEST_KEY})
    )


def worker_of(folder: Path, out: str = "out", **options: Any) -> tuple[ImageWorker, list[Job]]:
    """Return a worker that develops the renders in "in" to PNGs, and its jobs."""
    request, made = Request.from_options(formats=("png",), **options), folder / out
    made.mkdir(exist_ok=True)
    loader, jobs = ImageLoader(request), find_jobs([str(folder / "in")], made)
    chain = loader.first_chain(jobs)
    return ImageWorker(loader, Folder(OutputWriter(made, request.with_outputs(chain))), chain), jobs


@contextmanager
def file_limit(size: int) -> Iterator[None]:
    """Limit the size of files in bytes, like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def fail_launches(monkeypatch: pytest.MonkeyPatch, error: BaseException, *numbers: int) -> None:
    """Make kernel launches fail by their numbers, counted from now."""
    launch, count = cl.enqueue_nd_range_kernel, itertools.count()

    def launched(*arguments: Any, **options: Any) -> cl.Event:
        if next(count) in numbers:
            raise error
        return launch(*arguments, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", launched)


@pytest.fixture
def launches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """Record the global sizes of the following launches."""
    seen, launch = [], cl.enqueue_nd_range_kernel

    def launched(queue: Any, kernel: Any, size: Any, *rest: Any, **options: Any) -> cl.Event:
        seen.append(tuple(size))
        return launch(queue, kernel, size, *rest, **options)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", launched)
    return seen


@pytest.fixture(scope="session", autouse=True)
def _compiling_is_not_logged() -> None:
    # With a cold cache, the log line would appear in the output of the first test that compiles.
    programs._notice_logged.set()


@pytest.fixture(scope="session")
def device() -> Iterator[Device]:
    device = Device(choose(None, find_devices()))
    ours = programs.programs_of(device.info)
    declared = ours.declares
    yield device
    # All compiled kernels, ours and those of tests, call only functions that builtins.h declares.
    assert ours.declares == declared


@pytest.fixture(scope="session")
def scalar_device(device: Device) -> Device:
    """Return the device with one lane, like a GPU, so kernels are scalar code."""
    return Device(replace(device.info, lanes=1))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of additional files whose licences do not allow redistribution."""
    if not SHARED.is_dir():
        pytest.skip("needs the files in ../shared/data that tests/data/README.md lists")
    return SHARED


@pytest.fixture
def develop(device: Device) -> Callable[..., Result]:
    """Run a chain, given as nested settings, on one image: on the device or in NumPy."""

    def run(
        image: np.ndarray,
        key: str = "test",
        numpy: bool = False,
        source: Kind = Kind.RGB,
        keep: tuple[str, ...] = (),
        encode: bool = False,
        **settings: Any,
    ) -> Result:
        chain = make_chain(settings_from(settings), source)
        runner = Runner(chain, None if numpy else device, keep, encode=encode, final=True)
        return runner.run(image, key)

    return run


@pytest.fixture
def write_exr(tmp_path: Path) -> Callable[..., Path]:
    """Write an EXR with any channels, format and windows."""

    def write(
        name: str,
        pixels: np.ndarray,
        channels: str = "R,G,B",
        half: bool = True,
        **spec_fields: int,
    ) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        spec = oiio.ImageSpec(
            pixels.shape[1], pixels.shape[0], pixels.shape[2], oiio.HALF if half else oiio.FLOAT
        )
        spec.channelnames = tuple(channels.split(","))
        spec.attribute("DateTime", WRITTEN)
        for field, value in spec_fields.items():
            setattr(spec, field, value)
        file = oiio.ImageOutput.create(str(path))
        assert file.open(str(path), spec)
        assert file.write_image(np.ascontiguousarray(pixels, np.float32))
        assert file.close()
        return path

    return write


@pytest.fixture
def renders(
    write_exr: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """Write small renders of two sizes into a folder of the working directory, an empty one."""
    monkeypatch.chdir(tmp_path)

    def write(count: int = 6, folder: str = "in") -> str:
        rng = np.random.default_rng(0)
        for i in range(count):
            size = (24, 32) if i % 2 else (17, 40)
            write_exr(f"{folder}/r{i:03}.exr", rng.random((*size, 3)).astype(np.float32))
        return folder

    return write


@pytest.fixture(scope="session")
def two_renders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small renders, one of them in a subfolder."""
    folder = tmp_path_factory.mktemp("explore") / "renders"
    (folder / "left").mkdir(parents=True)
    y, x = np.mgrid[0:63, 0:96] / 96
    for i, name in enumerate(("a", "left/b")):
        picture = np.stack([0.2 + 0.5 * x, 0.6 - 0.5 * y, 0.3 + 0.2 * np.sin(9 * x + i)], -1)
        write_file(folder / f"{name}.exr", picture.astype(np.float32), ("R", "G", "B"), {})
    return folder


@pytest.fixture
def clpipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., ClickResult]:
    """The command line in an empty folder, see :func:`run_cli`."""
    monkeypatch.chdir(tmp_path)
    return run_cli


@pytest.fixture
def forget_stage_files(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Forget the stage files that were loaded, now and when it is called, until the test ends."""

    def forget() -> None:
        monkeypatch.setattr("clpipe.chain.registry._from_files", {})

    forget()
    return forget


@pytest.fixture
def browser_page() -> Iterator[Any]:
    """A Chromium page whose console must stay empty.

    But for a line of Chromium's own for each answer with status 400, which is a refusal that the
    page shows.
    """
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if not chromium:
        pytest.skip("needs the program chromium")
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1400, "height": 900})
        console: list[str] = []
        page.on("console", lambda message: console.append(message.text))
        page.on("pageerror", lambda error: console.append(str(error)))
        yield page
        assert [text for text in console if "status of 400" not in text] == []
        browser.close()
