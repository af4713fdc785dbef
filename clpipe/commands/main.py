"""The command ``clpipe``: a group of commands, each imported on first use."""

import gc
import io
import logging
import os
import re
import sys
import traceback
from importlib import import_module
from typing import Any, NoReturn

import click
from click.shell_completion import CompletionItem

from clpipe.base.about import full_version
from clpipe.base.errors import ClpipeError, DeviceError, OutputError, RequestError
from clpipe.base.interface import command_line
from clpipe.base.memory import check_address_space
from clpipe.base.system import max_address_space, processors, use_single_heap
from clpipe.base.text import one_line, quote_alternatives, similar_names
from clpipe.commands.docstrings import docstring_of
from clpipe.commands.notices import NOTICES

# Commands by heading of the help. Each is a module of this package that defines a function of its
# name.
GROUPS = {
    "Make pictures": ("demo", "run", "replay", "dataset", "stream"),
    "View and measure results": (
        "status",
        "report",
        "explore",
        "compare",
        "measure",
        "quality",
        "poses",
    ),
    "Cameras": ("cameras", "calibrate", "emva", "match"),
    "Stages and devices": ("stages", "plan", "devices", "check", "bench"),
}
COMMANDS = tuple(name for names in GROUPS.values() for name in names)

# Bytes; address space for the libraries, and for each of their threads. The libraries start one
# thread per processor.
LIBRARY_ADDRESSES = 240 << 20
THREAD_ADDRESSES = 10 << 20


class LazyGroup(click.Group):
    """Commands that are imported on first use. An error becomes one message and an exit status."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args[:1] == ["help"]:
            args = [*args[1:], "--help"]
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            hint = " Options follow the command, as in 'clpipe run --iso 800'."
            ctx.fail(error.format_message() + hint * (not error.possibilities))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args[0] not in COMMANDS and not ctx.resilient_parsing:
            ctx.fail(f"No such command '{one_line(args[0])}'.{suggestion(args[0])}")
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        prepare_memory()
        # Imported objects remain in use, and collecting garbage takes a tenth of the time.
        gc.disable()
        command = getattr(import_module(f"clpipe.commands.{cmd_name}"), cmd_name)
        gc.enable()
        assert isinstance(command, click.Command)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for heading, names in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(name, summary(name)) for name in names])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        # The base class's method would import every command.
        names = [name for name in COMMANDS if name.startswith(incomplete)]
        items = [CompletionItem(name, help=summary(name)) for name in names]
        return [*items, *click.Command.shell_complete(self, ctx, incomplete)]

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with command_line():
                return super().invoke(ctx)
        except ClpipeError as error:
            fail(error)
        except KeyboardInterrupt:
            click.echo("interrupted", err=True)
            sys.exit(130)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return super().main(*args, **kwargs)
        except BrokenPipeError:
            sys.exit(0)
        except OSError as error:
            fail(os_error(error))
        except MemoryError:
            fail(
                DeviceError(
                    "there is not enough memory to continue; finished pictures are complete, so "
                    "repeat the command to resume"
                )
            )


def suggestion(text: str) -> str:
    """Return the end of a message about an unknown command: what the user probably meant."""
    from clpipe.camera.profile import built_in_name
    from clpipe.chain.registry import all_stages

    if os.path.exists(text):
        return f" It is a file or folder; to develop it, use 'clpipe run {text} -o OUT'."
    if text in all_stages():
        return f" It is a stage; to see what it does, use 'clpipe stages {text}'."
    if camera := built_in_name(text):
        return f" It is a camera; to see its noise, use 'clpipe cameras {camera}'."
    stages = (f"stages {name}" for name in all_stages())
    matches = similar_names(
        text, (*COMMANDS, "cameras import", "--version"), 0.62
    ) or similar_names(text, stages)
    if not matches:
        return f" The commands are {', '.join(COMMANDS)}."
    return f" Did you mean {quote_alternatives(f'clpipe {name}' for name in matches)}?"


def prepare_memory() -> None:
    """Save address space if it is limited, and check that the libraries fit into it."""
    if max_address_space() is None:
        return
    use_single_heap()
    try:
        check_address_space(
            LIBRARY_ADDRESSES + THREAD_ADDRESSES * processors(), "loading clpipe's libraries"
        )
    except DeviceError as error:
        fail(error)


def os_error(error: OSError) -> ClpipeError:
    """Return clpipe's error for an error of the operating system, with the file's name if any."""
    if error.filename is not None:
        return OutputError(f"{error.filename}: {error.strerror or error}")
    # The error has no file name only if the working directory is missing.
    if isinstance(error, FileNotFoundError):
        return RequestError("the working directory no longer exists; change to another one")
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    package, _, _ = innermost.f_globals["__name__"].partition(".")
    if package in ("click", "rich"):
        return RequestError(f"cannot print: {error.strerror}")
    return OutputError(f"the operating system reported an error: {error.strerror or error}")


def summary(name: str) -> str:
    """Return the first sentence of a command's help, up to a colon, from its source.

    Importing all commands would take ten times as long.
    """
    text = docstring_of(f"commands.{name}", name)
    return re.split(r"[.:](?=\s|$)", " ".join(text.split()))[0]


def fail(error: ClpipeError) -> NoReturn:
    """Print an error and exit with its status."""
    lines = map(one_line, str(error).split("\n"))  # a compiler's message has several lines
    click.echo("clpipe: " + "\n".join(lines), err=True)
    sys.exit(error.exit_status)


def print_version(context: click.Context, _: click.Parameter, is_set: bool) -> None:
    """Print the version with the commit, which is slow to look up, and exit."""
    if is_set and not context.resilient_parsing:
        click.echo(f"clpipe, version {full_version()}")
        context.exit()


@click.group(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.option(
    "--version",
    is_flag=True,
    expose_value=False,
    is_eager=True,
    callback=print_version,
    help="Show the version and exit.",
)
def main() -> None:
    """Simulate a camera on clean, linear renders: mosaic, sensor noise, development.

    \b
    clpipe run render.exr -o out --iso 3200
    clpipe stages sensor_noise
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file's name may not be UTF-8
        sys.stdout.reconfigure(errors="backslashreplace")  # like stderr
    logger = logging.getLogger("clpipe")
    logger.setLevel(logging.INFO)
    if NOTICES not in logger.handlers:
        logger.addHandler(NOTICES)
