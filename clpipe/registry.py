"""Every stage there is: clpipe's own, those of installed packages, those of files a user named."""

import traceback
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from clpipe.errors import RequestError
from clpipe.stage import Stage
from clpipe.stages import own_stages

ENTRY_POINTS = "clpipe.stages"
_from_files: dict[Path, Stage] = {}


def all_stages() -> dict[str, Stage]:
    """Every stage by its name: clpipe's own, the default chain first, then the others."""
    return {
        **own_stages(),
        **installed_stages(),
        **{stage.name: stage for stage in _from_files.values()},
    }


@cache
def installed_stages() -> dict[str, Stage]:
    """The stages that installed packages offer as entry points of the group ``clpipe.stages``.

    Raises:
        RequestError: one cannot be loaded, is no stage, or has a name that is taken.
    """
    found: dict[str, Stage] = {}
    for entry in entry_points(group=ENTRY_POINTS):
        package = f"package {entry.dist.name}" if entry.dist else f"entry point {entry.name}"
        stage, file = _loaded(package, entry)
        _check_name(package, stage.name, own_stages() | found)
        found[stage.name] = replace(stage, folder=file.parent)
    return found


def load_stage_file(path: Path) -> Stage:
    """Load a stage from a Python file that defines ``STAGE``; its kernels lie in the same folder.

    Raises:
        RequestError: the file cannot be read or run, defines no stage, or one whose name is taken.
    """
    where = path.resolve()
    if where not in _from_files:
        spec = spec_from_file_location(f"clpipe_stage_{path.stem}", where)
        if path.suffix != ".py" or spec is None or spec.loader is None:
            raise RequestError(f"{path}: a stage file is a Python file, ending in .py")
        if not where.is_file():
            raise RequestError(f"{path}: no such file")
        module = module_from_spec(spec)
        stage, _ = _loaded(str(path), module)
        _check_name(str(path), stage.name, all_stages())
        _from_files[where] = replace(stage, folder=where.parent)
    return _from_files[where]


def _loaded(place: str, source: EntryPoint | ModuleType) -> tuple[Stage, Path]:
    """The stage of an entry point or of a module still to be run, and the file it stands in."""
    try:
        if isinstance(source, EntryPoint):
            stage = source.load()
            module = __import__(source.module, fromlist=["_"])
        else:
            module = source
            assert module.__spec__ and module.__spec__.loader
            module.__spec__.loader.exec_module(module)
            stage = getattr(module, "STAGE", None)
    except SyntaxError as error:
        raise RequestError(f"{error.filename}, line {error.lineno}: {error.msg}") from None
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        line = f", line {frames[-1].lineno} of {frames[-1].filename}" if frames else ""
        raise RequestError(f"{place}{line}: {type(error).__name__}: {error}") from None
    if not isinstance(stage, Stage):
        raise RequestError(f"{place}: STAGE is not there, or is no clpipe.stage.Stage")
    file = Path(str(module.__file__))
    for method in stage.methods:
        kernel = file.parent / f"{method.kernel}.cl"
        if method.kernel and not kernel.is_file():
            raise RequestError(f"{place}: its kernel {kernel} is not there")
    return stage, file


def _check_name(place: str, name: str, taken: dict[str, Stage]) -> None:
    if not name.isidentifier() or name[-1].isdecimal():
        raise RequestError(
            f"{place}: its stage is called '{name}'; "
            "a name has letters, digits and _, and no digit last"
        )
    if name in taken:
        owner = taken[name].folder or "clpipe itself"
        raise RequestError(
            f"{place}: its stage is called '{name}', but that name is taken ({owner}); "
            "choose another"
        )
