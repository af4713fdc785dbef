"""Shell completion of the names of cameras, configurations, stages and parameters.

Each function has the signature of click's ``shell_complete``. It imports packages when it is
called, because every command imports this module.
"""

from collections.abc import Iterable
from pathlib import Path

import click
from click.shell_completion import CompletionItem

from clpipe.base.errors import ClpipeError


def cameras(context: click.Context, option: click.Parameter, text: str) -> list[CompletionItem]:
    """Complete built-in cameras, by name or alias, and files."""
    from clpipe.camera.profile import built_in_cameras, camera_names
    from clpipe.camera.text import normalized_name

    names = [name for name in built_in_cameras() if name.startswith(text)]
    if not names and (start := normalized_name(text)):
        names = sorted({name for key, name in camera_names().items() if key.startswith(start)})
    return _names(names, "") or _file(text)


def cameras_or_import(
    context: click.Context, option: click.Parameter, text: str
) -> list[CompletionItem]:
    """Complete built-in cameras, files, and the command that imports a profile."""
    return [*_names(["import"] if text else [], text), *cameras(context, option, text)]


def configs(context: click.Context, option: click.Parameter, text: str) -> list[CompletionItem]:
    """Complete built-in configurations, and files."""
    from clpipe.chain.files import built_in_configs

    return _names(built_in_configs(), text) or _file(text)


def steps(context: click.Context, option: click.Parameter, text: str) -> list[CompletionItem]:
    """Complete stages, in the order of the default chain."""
    return _names(_stages(context), text)


def steps_or_all(
    context: click.Context, option: click.Parameter, text: str
) -> list[CompletionItem]:
    """Complete stages, and "all"."""
    return _names(["all", *_stages(context)], text)


def stage_lists(context: click.Context, option: click.Parameter, text: str) -> list[CompletionItem]:
    """Complete the stage after the last comma."""
    before, comma, last = text.rpartition(",")
    return [CompletionItem(before + comma + item.value) for item in _names(_stages(context), last)]


def methods_of(context: click.Context, option: click.Parameter, text: str) -> list[CompletionItem]:
    """Complete stages that have more than one method."""
    from clpipe.chain.registry import all_stages

    names = _stages(context)
    return _names([name for name in names if len(all_stages()[name].methods) > 1], text)


def parameters(context: click.Context, option: click.Parameter, text: str) -> list[CompletionItem]:
    """Complete ``stage.``, then ``stage.parameter=``, then the methods of ``stage.method=``."""
    from clpipe.chain.methods import base_name
    from clpipe.chain.registry import all_stages

    names = _stages(context)
    step, dot, rest = text.partition(".")
    if not dot:
        return _names([f"{name}." for name in names], text)
    stage = all_stages().get(base_name(step))
    if stage is None:
        return []
    if rest.startswith("method="):
        return _names([f"{step}.method={method}" for method in stage.by_name], text)
    of_methods = [name for method in stage.methods for name in method.model_fields]
    return _names([f"{step}.{name}=" for name in dict.fromkeys(["method", *of_methods])], text)


def _stages(context: click.Context) -> list[str]:
    """Return the names of all stages, also from each ``--stage-file`` that can be loaded."""
    from clpipe.chain.registry import all_stages, load_stage_file

    try:
        for file in context.params.get("stage_files") or ():
            load_stage_file(Path(file))
        return list(all_stages())
    except ClpipeError:
        return []


def _names(names: Iterable[str], text: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in names if name.startswith(text)]


def _file(text: str) -> list[CompletionItem]:
    """Return the item that lets the shell complete file names."""
    return [CompletionItem(text, type="file")]


# Completion functions by option, or by what the help writes in place of an option's value.
COMPLETIONS = {
    "camera": cameras,
    "config": configs,
    "A,B,C": stage_lists,
    "STAGE": steps,
    "STAGE|all": steps_or_all,
}
