"""Export of the settings of a page: a configuration, and commands that use it."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clpipe.chain.files import config_text
from clpipe.chain.keys import KEYS, TABLES
from clpipe.chain.registry import stage_in
from clpipe.chain.request import Request
from clpipe.chain.toml import value_text
from clpipe.explorer.explorer import Explorer
from clpipe.images.pixels import DEFAULT_MAX_PIXELS
from clpipe.inputs.find import Job
from clpipe.stage import StageRole

OUT = "out"  # the output directory in the commands
SAVED = "camera.toml"  # the file name of a saved configuration


def exported(explorer: Explorer, image: int, values: Mapping[str, Any]) -> dict[str, str]:
    """Return values as texts: "config", "command" for the image, and "folder" for its directory.

    Raises:
        ClpipeError: a value is not allowed.
    """
    request = explorer.request(values)
    steps = (*request.settings().step_names, stage_in(StageRole.SPECTRUM).name)
    used = {key: v for key, v in values.items() if key in (*KEYS, *TABLES, *steps)}
    job, reading = explorer.job(image), _reading_options(request)
    files = [Path(file) for file in request.stage_files]
    loading = [part for file in files for part in ("--stage-file", str(file))]
    options, saved = options_of(used), ["-c", SAVED]
    own = saved if options is None else [*loading, *options]
    carries = explorer.overrides_embedded
    # A configuration replaces the settings that a kept image carries, so it must contain them.
    config = explorer.settings(image, values).record() if carries else values
    return {
        "config": config_text(config, files),
        "command": run_command([input_of(job)], reading + own),
        "folder": run_command(inputs_of(explorer.jobs), reading + (own if carries else saved)),
    }


def run_command(sources: Sequence[Path], options: list[str]) -> str:
    """Return the shell command that develops files and directories."""
    named = [f"./{source}" if str(source).startswith("-") else str(source) for source in sources]
    return shlex.join(["clpipe", "run", *named, "-o", OUT, *options])


def inputs_of(jobs: Sequence[Job]) -> list[Path]:
    """Return the inputs of images. For a single file, this is its directory."""
    if len(jobs) == 1:
        return [input_folder_of(jobs[0])]
    return list(
        dict.fromkeys(job.path if job.named_by_user else input_folder_of(job) for job in jobs)
    )


def input_folder_of(job: Job) -> Path:
    """Return the directory to which the key of an image is relative."""
    return job.path.parents[len(Path(job.key).parts) - 1]


def input_of(job: Job) -> Path:
    """Return the input for ``clpipe run`` with which an image has the same key and noise.

    >>> input_of(Job(Path("a/b.exr"), "b.exr")), input_of(Job(Path("a/left/b.exr"), "left/b.exr"))
    (PosixPath('a/b.exr'), PosixPath('a'))
    """
    return job.path if job.key == job.path.name else input_folder_of(job)


def options_of(values: Mapping[str, Any]) -> list[str] | None:
    """Return nested values as options of ``clpipe run``. None if options cannot express them.

    >>> options_of({"iso": 800.0, "skip": ["gamma"], "denoise": {"method": "mean", "radius": 2}})
    ['--iso', '800', '--skip', 'gamma', '--set', 'denoise.method=mean', '--set', 'denoise.radius=2']
    """
    options: list[str] = []
    for key, value in values.items():
        option = f"--{key.replace('_', '-')}"
        if key not in KEYS:
            for name, each in value.items():
                text = each if name == "method" and isinstance(each, str) else value_text(each)
                options += ["--set", f"{key}.{name}={text}"]
        elif isinstance(value, Mapping):
            return None  # a draw
        elif key == "stages":
            options += [option, ",".join(value)]
        elif key == "skip":
            options += [part for name in value for part in (option, name)]
        else:
            options += [option, value if isinstance(value, str) else value_text(value)]
    return options


def _reading_options(request: Request) -> list[str]:
    """Return the options of a request for reading images and for the ends of the chain."""
    own = {
        "--start-at": request.start_at,
        "--until": request.until,
        "--layer": request.layer,
        "--transfer": request.transfer,
        "--max-pixels": None if request.max_pixels == DEFAULT_MAX_PIXELS else request.max_pixels,
    }
    return [str(part) for option, value in own.items() if value for part in (option, value)]
