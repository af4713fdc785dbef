"""Many image files through one chain: which files, under which names, with which sidecars."""

import glob
import json
import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import clpipe
from clpipe.config import Chain
from clpipe.device import Device
from clpipe.dng import negative_of, write_dng
from clpipe.errors import ImageError, KindError, RequestError
from clpipe.image_io import (
    CARRIED,
    JPEG_MAX_SIDE,
    READABLE,
    Reading,
    SourceImage,
    Tags,
    carried,
    upright,
    versions,
    write_beside,
    write_display,
    write_exr,
)
from clpipe.raw_entry import RawEntry, RawImage
from clpipe.raw_io import ENDINGS
from clpipe.reentry import Reentry, attributes_of, doubts, misplaced
from clpipe.reference.curve import to_16_bit
from clpipe.run import Result, Runner
from clpipe.stage import Kind


@dataclass(frozen=True)
class Format:
    """A kind of file: how its name ends, and how many bits its samples have; floats or not."""

    ending: str
    bits: int
    floats: bool = False


FORMATS = {
    "jpg": Format("jpg", 8),
    "png": Format("png", 8),
    "png16": Format("png", 16),
    "tif": Format("tif", 8),
    "tif16": Format("tif", 16),
    "tif32": Format("tif", 32, floats=True),
    "exr": Format("exr", 32, floats=True),
    "exr16": Format("exr", 16, floats=True),
}
DNG = "dng"  # not of the last image, but of the raw
EVERY_FORMAT = (*FORMATS, DNG)


@dataclass(frozen=True)
class Job:
    """One input file, and its name relative to the input root: the image key, with its ending."""

    path: Path
    key: str
    listed: bool = True  # by name or glob; otherwise found in a folder


@dataclass(frozen=True)
class Outcome:
    """What became of one job."""

    job: Job
    megapixels: float
    seconds: float
    warnings: tuple[str, ...] = ()
    error: str = ""
    left_out: bool = False  # kept after another stage than the one to go on from


def find_jobs(
    inputs: Sequence[str], output: Path, endings: Sequence[str] = (*READABLE, *ENDINGS)
) -> list[Job]:
    """The files that inputs name: files, folders (all images in them, at any depth) and globs.

    The image key of a file in a folder is its path relative to that folder, that of a file given
    by name or found by a glob is its name. A file that does not exist is a job too: it fails later,
    alone. Where the output folder lies inside an input folder, what is in it is no input.

    Raises:
        RequestError: an empty name, a folder without images, or a glob that no file matches.
    """
    jobs: list[Job] = []
    for text in inputs:
        if not text:
            raise RequestError("an input is empty; give files, folders or globs")
        path = Path(text)
        if os.path.isdir(text):
            files = images_in(path, output, endings)
            if not files:
                listed = ", ".join(e for e in endings if e not in ENDINGS)
                raws = " and camera raws" if set(ENDINGS) & set(endings) else ""
                raise RequestError(f"{path}: a folder without images (looked for {listed}{raws})")
            jobs += [Job(p, p.relative_to(path).as_posix(), listed=False) for p in files]
        elif glob.has_magic(text) and not os.path.exists(text):
            matches = sorted(m for m in glob.glob(text, recursive=True) if os.path.isfile(m))
            if not matches:
                raise RequestError(f"{text}: no file matches")
            jobs += [Job(Path(m), Path(m).name) for m in matches]
        else:
            jobs.append(Job(path, path.name))
    return jobs


def images_in(folder: Path, output: Path, endings: Sequence[str]) -> list[Path]:
    """The files in a folder at any depth that end so, sorted; hidden ones and a folder in it that
    is the output aside, links followed.
    """
    found: list[Path] = []
    seen: set[str] = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        led_back = real in seen
        if led_back or (seen and real == os.path.realpath(output)):
            folders.clear()
            continue
        seen.add(real)
        found += [
            Path(place, n)
            for n in names
            if not n.startswith(".") and os.path.splitext(n)[1].lower() in endings
        ]
    return sorted(path for path in found if path.is_file())


def prepare_folder(folder: Path) -> None:
    """Make the output folder, and see that it can be written.

    Raises:
        RequestError: it cannot.
    """
    probe = folder / f".clpipe.{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise RequestError(f"{folder}: cannot write there: {error.strerror}") from None


@dataclass(frozen=True)
class Burst:
    """How many frames are made of each image; None is one, without anything beside it."""

    frames: int | None = None

    def names(self) -> tuple[str, ...]:
        """What stands behind the image's name for each picture that is made of it.

        >>> Burst(2).names(), Burst().names()
        (('.truth', '.frame0', '.frame1'), ('',))
        """
        if self.frames is None:
            return ("",)
        digits = len(str(self.frames - 1))
        return (".truth", *(f".frame{i:0{digits}}" for i in range(self.frames)))

    def shots(self, runner: Runner, key: str) -> Iterator[tuple[str, Runner, str]]:
        """For each picture its name, how it is made, and its image key.

        The first frame is the picture that there is without a burst; the truth has no noise.
        """
        first, *others = self.names()
        if not others:
            yield first, runner, key
            return
        clean = runner.chain.clean()
        kept = [step.name for step in clean.steps if step.name in runner.keep]
        yield first, Runner(clean, runner.device, kept, runner.encode, runner.final), key
        for number, name in enumerate(others):
            yield name, runner, f"{key}#{number}" if number else key


@dataclass(frozen=True)
class Target:
    """Where results go, in which formats, how many of each image, and which stages' images too."""

    folder: Path
    formats: tuple[str, ...]
    burst: Burst = Burst()
    keep: tuple[str, ...] = ()

    def runner(self, chain: Chain, device: Device | None) -> Runner:
        """What makes all that is to be written, and nothing else."""
        made = [FORMATS[f] for f in self.formats if f != DNG]
        raw = negative_of(chain).step if DNG in self.formats else None
        return Runner(
            chain,
            device,
            tuple(dict.fromkeys([*self.keep, *([raw] if raw else [])])),
            encode=any(f.bits == 8 for f in made),
            final=any(f.bits > 8 for f in made),
        )

    def check(self, chain: Chain, jobs: Sequence[Job]) -> None:
        """See that the results can be written in these formats, over no input and no other result.

        Raises:
            RequestError: they cannot.
        """
        few = [f for f in self.formats if f != DNG and FORMATS[f].bits < 32]
        if few and chain.result is Kind.RAW:
            raise RequestError(
                f"the chain ends in DN, which {few[0]} cannot hold; "
                "end it with normalize or a later stage, or use --format dng or exr"
            )
        if DNG in self.formats:
            negative_of(chain)  # refuses a chain without a raw
        endings: dict[str, str] = {}
        for format_ in self.formats:
            other = endings.setdefault(ending_of(format_), format_)
            if other != format_:
                raise RequestError(
                    f"--format {other} and {format_} would both write NAME.{ending_of(format_)}; "
                    "run them into different folders"
                )
        inputs = {os.path.realpath(job.path) for job in jobs}
        makers: dict[Path, Job] = {}
        every = ("json", *endings, *(f"{step}.exr" for step in self.keep))
        names = self.burst.names()
        for job in jobs:
            for path in (self.path(job, e, name) for name in names for e in every):
                if os.path.realpath(path) in inputs:
                    raise RequestError(
                        f"{path} is an input and would be overwritten; choose another output folder"
                    )
                if path in makers:
                    raise RequestError(
                        f"{makers[path].path} and {job.path} would both write {path}; "
                        "run them into different folders"
                    )
                makers[path] = job

    def path(self, job: Job, ending: str, name: str = "") -> Path:
        """The output of a job with that ending; ``name`` is one of the burst's."""
        return self.folder / f"{Path(job.key).with_suffix('')}{name}.{ending}"

    def check_size(self, source: SourceImage) -> None:
        """See that an image fits into the formats.

        Raises:
            ImageError: it is too large for one.
        """
        if "jpg" in self.formats and max(source.pixels.shape[:2]) > JPEG_MAX_SIDE:
            raise ImageError(f"JPEG holds at most {JPEG_MAX_SIDE} pixels a side; use --format png")

    def write(
        self,
        job: Job,
        name: str,
        key: str,
        runner: Runner,
        source: SourceImage,
        result: Result,
    ) -> None:
        """Write a job's images, or those of one picture of its burst, then the sidecar.

        Raises:
            ImageError: a file cannot be written.
        """
        chain, camera = runner.chain, runner.chain.camera
        own = Tags(camera.make, camera.model, chain.iso)
        tags, orientation = carried(source.attributes, own)
        how = chain.settings.output.filled({**source.shot, **tags.shot})
        tags = replace(tags, output=how)
        brought = {name: source.attributes[name] for name in CARRIED if name in source.attributes}
        mosaic = chain.result in (Kind.RAW, Kind.MOSAIC)
        turn = 1 if mosaic else orientation  # to turn a mosaic would be to change its pattern
        outputs = []
        for step in chain.steps:
            if step.name in self.keep:
                path = self.path(job, f"{step.name}.exr", name)
                attributes = attributes_of(step, chain, key) | brought
                write_exr(path, result.kept[step.name], step.stage.writes.channels, attributes)
                outputs.append(path.name)
        for format_ in self.formats:
            path = self.path(job, ending_of(format_), name)
            if format_ == DNG:
                negative = negative_of(chain)
                raw = result.kept[negative.step] if negative.step else source.pixels
                write_dng(path, raw, negative, tags, orientation)
            else:
                attributes = attributes_of(chain.steps[-1], chain, key) | brought
                write_last(path, FORMATS[format_], result, chain, attributes, tags, turn)
            outputs.append(path.name)
        record = sidecar(job, key, runner, source, result, outputs)
        text = json.dumps(record, indent=2) + "\n"
        write_beside(self.path(job, "json", name), lambda to: _write_text(to, text))


def ending_of(format_: str) -> str:
    """How the name of a file of a format ends."""
    return DNG if format_ == DNG else FORMATS[format_].ending


def write_last(
    path: Path,
    format_: Format,
    result: Result,
    chain: Chain,
    attributes: Mapping[str, str],
    tags: Tags,
    orientation: int,
) -> None:
    """Write the last image of a chain, turned as EXIF's ``orientation`` says.

    Raises:
        ImageError: the file cannot be written.
    """
    pixels = result.encoded
    if format_.bits > 8:
        assert result.final is not None
        pixels = result.final if format_.floats else to_16_bit(result.final)
    if format_.ending == "exr":
        pixels = result.final
    assert pixels is not None
    pixels = upright(pixels, orientation)
    if format_.ending == "exr":
        if orientation != 1:
            attributes = {**attributes, "orientation": "1"}
        channels = chain.result.channels
        write_exr(path, pixels, channels, attributes, half=format_.bits == 16)
    else:
        write_display(path, pixels, tags)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text)


def sidecar(
    job: Job,
    key: str,
    runner: Runner,
    source: SourceImage,
    result: Result,
    outputs: Sequence[str],
) -> dict[str, Any]:
    """Everything that is needed to make the same files again."""
    chain = runner.chain
    device = runner.device
    raw = source.said if isinstance(source, RawImage) else None
    noise = chain.noise if not raw or chain.is_noisy else None
    return {
        "clpipe": clpipe.__version__,
        "input": str(job.path),
        "sha256": source.sha256,
        "layer": source.layer,
        "image_key": key,
        "seed": chain.seed,
        "width": source.pixels.shape[1],
        "height": source.pixels.shape[0],
        "camera": chain.camera.name,
        "iso": chain.iso,
        "output": chain.settings.output.filled(source.shot).model_dump(),
        "noise": noise.record() if noise else None,
        "starts_on": chain.source.label,
        **({"raw": asdict(raw)} if raw else {}),
        "stages": [
            {
                "name": step.name,
                "stage": step.stage.name,
                "method": step.method.method,
                "parameters": step.method.model_dump(),
                **({"found": result.found[step.name]} if step.name in result.found else {}),
            }
            for step in chain.steps
        ],
        "outputs": list(outputs),
        "warnings": list(source.warnings),
        "device": {
            "name": device.info.name if device else "numpy",
            "platform": device.info.platform if device else "numpy",
            "version": device.info.version if device else version("numpy"),
            "driver": device.info.driver if device else "",
            "lanes": device.info.lanes if device else 0,
        },
        "versions": {
            "python": platform.python_version(),
            "numpy": version("numpy"),
            "pyopencl": version("pyopencl"),
            **versions(),
        },
    }


def enter(
    job: Job, source: SourceImage, runner: Runner, reentry: Reentry | None, raws: RawEntry
) -> tuple[Runner, SourceImage, str] | None:
    """How to go on with an image: its runner, the image with warnings, its key.

    None for one that was found in a folder of kept images and is not the one to go on from.

    Raises:
        ImageError: it cannot enter there.
    """
    if isinstance(source, RawImage):
        chain, source = raws.enter(job.path, source)
        keep = [name for name in runner.keep if name in {s.name for s in chain.steps}]
        return Runner(chain, runner.device, keep, runner.encode, runner.final), source, job.key
    kept, warnings, key = source.attributes.get("stage"), list(source.warnings), job.key
    if reentry:
        chain = reentry.chain_for(job.path, source.attributes)
        if not reentry.is_next(chain, source.attributes):
            if not job.listed:
                return None
            again = f"entering at {reentry.start_at} repeats stages or leaves some out"
            warnings.append(f"was kept after {kept}; {again}")
        reentry.check_kind(job.path, chain, source.attributes)
        warnings += doubts(source, chain)
        runner, key = runner.of(chain), source.attributes.get("image_key", key)
    elif kept:
        warnings.append(f"was kept after {kept}; is it a render? See --start-at")
    return runner, replace(source, warnings=tuple(warnings)), key


def run_jobs(
    jobs: Sequence[Job],
    runner: Runner,
    target: Target,
    raws: RawEntry,
    how: Reading,
    reentry: Reentry | None = None,
) -> Iterator[Outcome]:
    """Put every job through; one that fails is reported and the others go on.

    The next file is read, and the first one read while the kernels compile, in a second thread.
    """
    kind = runner.chain.source
    reading_of = partial(raws.read, kind=kind, how=how)
    with ThreadPoolExecutor(1) as reader:
        ahead = reader.submit(reading_of, jobs[0].path)
        runner.warm_up(half=reentry is None and kind is Kind.RGB)
        for i, job in enumerate(jobs):
            reading = ahead
            if i + 1 < len(jobs):
                ahead = reader.submit(reading_of, jobs[i + 1].path)
            start = time.perf_counter()
            try:
                source = reading.result()
                target.check_size(source)
                entered = enter(job, source, runner, reentry, raws)
                if entered is None:
                    yield Outcome(job, 0, 0, left_out=True)
                    continue
                own, source, key = entered
                for name, shot, shot_key in target.burst.shots(own, key):
                    result = shot.run(source.pixels, shot_key)
                    target.write(job, name, shot_key, shot, source, result)
            except KindError as error:
                if reentry and not job.listed:
                    yield Outcome(job, 0, 0, left_out=True)
                    continue
                message = misplaced(error, runner.chain, reentry)
                yield Outcome(job, 0, time.perf_counter() - start, error=message)
                continue
            except (ImageError, RequestError, MemoryError) as error:
                message = str(error) or "there is not enough memory for it"
                if str(job.path) not in message:
                    message = f"{job.path}: {message}"
                yield Outcome(job, 0, time.perf_counter() - start, error=message)
                continue
            height, width = source.pixels.shape[:2]
            seconds = time.perf_counter() - start
            yield Outcome(job, width * height / 1e6, seconds, source.warnings)
