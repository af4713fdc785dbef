"""The registry of stages: built in, from installed packages, and from stage files."""

import os
import re
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, lru_cache
from importlib import import_module
from importlib.machinery import SourceFileLoader
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import Any, Never

import numpy as np
from pydantic import ValidationError

from clpipe.base.errors import ClpipeError, RequestError
from clpipe.base.reading import check_exists, check_regular
from clpipe.chain.keys import NOISE
from clpipe.stage import CompileTime, Context, Method, Stage, StageRole, typed_arguments
from clpipe.stages import built_in_stages

ARGUMENT_TYPES = (np.float32, np.int32, np.uint32, np.ndarray, CompileTime)

ENTRY_POINTS = "clpipe.stages"

_from_files: dict[Path, Stage] = {}

_loading = RLock()  # ensures that each file runs only once


def all_stages() -> dict[str, Stage]:
    """Return all stages by name: built-in ones first, in the order of the default chain."""
    return _all_stages(tuple(_from_files.values()))


@lru_cache(maxsize=1)
def _all_stages(from_files: tuple[Stage, ...]) -> dict[str, Stage]:
    return {
        **built_in_stages(),
        **installed_stages(),
        **{stage.name: stage for stage in from_files},
    }


@cache
def installed_stages() -> dict[str, Stage]:
    """Return the stages that installed packages offer as entry points, group ``clpipe.stages``.

    Raises:
        RequestError: a stage cannot be loaded, is no stage, or has the name of another stage.
    """
    stages: dict[str, Stage] = {}
    for entry in entry_points(group=ENTRY_POINTS):
        package = f"package {entry.dist.name}" if entry.dist else f"entry point {entry.name}"
        stage = _load_stage(package, entry, built_in_stages() | stages)
        stages[stage.name] = stage
    return stages


def stage_in(role: StageRole) -> Stage:
    """Return the first stage that has a role, normally the built-in one."""
    return next(stage for stage in all_stages().values() if stage.role is role)


def load_stage_file(path: Path) -> Stage:
    """Load a stage from a Python file that defines ``STAGE``. Kernels are in the same directory.

    Raises:
        RequestError: the file cannot be read or run, defines no stage, or defines one with the
            name of another stage.
    """
    with _loading:
        return _load_file(path, Path(os.path.realpath(path)))


def loaded_stage_files(stages: Iterable[str]) -> list[Path]:
    """Return the loaded stage files whose stage is one of the named stages."""
    names = set(stages)
    return [path for path, stage in _from_files.items() if stage.name in names]


def code_files(stage_files: Iterable[Path]) -> list[Path]:
    """Return stage files and the kernels of their stages, which is all of their code.

    Raises:
        RequestError: as :func:`load_stage_file`.
    """
    files: list[Path] = []
    for file in stage_files:
        stage = load_stage_file(file)
        kernels = dict.fromkeys(m.kernel for m in stage.methods if m.kernel)
        files += [file, *(file.parent / f"{kernel}.cl" for kernel in kernels)]
    return files


class _SourceLoader(SourceFileLoader):
    """Loads a stage file from its text.

    Python's bytecode may be that of an earlier text with the same size, of the same second.
    """

    def path_stats(self, path: str) -> Never:
        raise OSError("no bytecode")  # the loader then neither reads nor writes it


def _load_file(path: Path, real_path: Path) -> Stage:
    if real_path not in _from_files:
        name = f"clpipe_stage_{path.stem}"
        loader = _SourceLoader(name, str(real_path))
        spec = spec_from_file_location(name, real_path, loader=loader)
        if path.suffix != ".py" or spec is None or spec.loader is None:
            raise RequestError(f"{path}: a stage file is a Python file; use one that ends in .py")
        check_exists(path)
        try:
            check_regular(real_path)
        except OSError as error:
            raise RequestError(f"{path}: cannot read the stage file: {error.strerror}") from None
        _from_files[real_path] = _load_stage(str(path), module_from_spec(spec), all_stages())
    return _from_files[real_path]


def _load_stage(
    place: str, source: EntryPoint | ModuleType, existing: Mapping[str, Stage]
) -> Stage:
    """Return the stage of an entry point, or of a module that this function runs.

    Args:
        place: the package or the file, for messages.
        source: the entry point or the module.
        existing: the stages whose names it must not have.

    Raises:
        RequestError: the stage cannot be loaded, or is not valid.
    """
    folder = Path(place).parent.resolve() if isinstance(source, ModuleType) else None
    with user_code_errors(place, folder):
        if isinstance(source, EntryPoint):
            stage = source.load()
            module = import_module(source.module)
        else:
            module = source
            assert module.__spec__ and module.__spec__.loader
            module.__spec__.loader.exec_module(module)
            stage = getattr(module, "STAGE", None)
    home = Path(str(module.__file__)).parent
    for problem in _problems(stage, home, existing):
        raise RequestError(f"{place}: {problem}")
    return replace(stage, folder=home)


def _problems(stage: Any, folder: Path, existing: Mapping[str, Stage]) -> Iterator[str]:
    """Yield what is wrong with a user's stage, whose kernels are in a folder."""
    if not isinstance(stage, Stage):
        yield "STAGE is missing or is not a clpipe.stage.Stage; define STAGE = Stage(...)"
    if not isinstance(stage.methods, tuple) or not stage.methods:
        yield f"the methods of {stage.name} must be a tuple: (Method,)"
    for method in stage.methods:
        if not (isinstance(method, type) and issubclass(method, Method)):
            yield f"{method!r} is not derived from Method; list subclasses of Method only"
        if missing := [n for n in ("method", "kernel", "summary") if not hasattr(method, n)]:
            yield f"{method.__name__} lacks {', '.join(missing)}; define this in the class"
        kernel = folder / f"{method.kernel}.cl"
        if method.kernel and not kernel.is_file():
            yield f"its kernel {kernel} does not exist; create this file"
    name, reason = stage.name, ""
    if not name.isidentifier() or name[-1].isdecimal():
        reason = "a name has only letters, digits and _, and does not end in a digit"
    elif name == NOISE:
        reason = "--skip uses this name for all noise"
    elif name in existing:
        owner = existing[name].folder or "clpipe itself"
        reason = f"another stage has this name ({owner})"
    if reason:
        yield f"its stage is called '{name}', but {reason}; choose another name"


@contextmanager
def user_code_errors(place: str, folder: Path | None) -> Iterator[None]:
    """Convert any error that a user's stage raises into a message with the line of its code.

    Args:
        place: the stage, for the message.
        folder: the directory of the stage's code; None for a built-in stage.

    Raises:
        RequestError: the stage raised an error.
    """
    try:
        yield
    except (ClpipeError, ValidationError):
        raise
    except SyntaxError as error:
        raise RequestError(f"{error.filename}, line {error.lineno}: {error.msg}") from None
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        user_frames = [f for f in frames if folder and Path(f.filename).resolve().parent == folder]
        at = (user_frames or frames)[-1]
        location = f"{at.filename}, line {at.lineno}: {type(error).__name__}: {error}"
        named = Path(place).resolve() == Path(at.filename).resolve()
        raise RequestError(location if named else f"{place}: {location}") from None


def check_passes(name: str, stage: Stage, method: Method, context: Context) -> None:
    """Check that the passes of a user's method fit its arguments and its kernel file.

    Raises:
        RequestError: they do not fit.
    """
    assert stage.folder
    kernel = stage.folder / f"{method.kernel}.cl"
    with user_code_errors(f"stage {name}", stage.folder):
        passes, arguments = method.passes(), typed_arguments(method.arguments(context))
        for pass_ in passes:
            names = [*arguments, *(name for p in passes for name in p.provides)]
            for argument in pass_.all_arguments:
                if argument not in names:
                    raise RequestError(
                        f"stage {name}: pass {pass_.function} needs the argument '{argument}', but "
                        f"arguments() returns {', '.join(arguments) or 'none'}; add '{argument}'"
                    )
            for function in pass_.functions:
                if not re.search(rf"\b{re.escape(function)}\s*\(", kernel.read_text("utf-8")):
                    raise RequestError(
                        f"stage {name}: a pass calls the function {function}, but {kernel} does "
                        "not define it; add it there"
                    )
        for argument, value in arguments.items():
            if not isinstance(value, ARGUMENT_TYPES):
                allowed = ", ".join(["float", "int", *(t.__name__ for t in ARGUMENT_TYPES)])
                raise RequestError(
                    f"stage {name}: arguments() returns {value!r} as '{argument}'; its type must "
                    f"be one of {allowed}"
                )
