"""The base class of commands, and options that several commands share.

The options that set keys are in :mod:`clpipe.commands.chain_options`.
"""

import logging
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from clpipe.base.errors import MissingError, RequestError
from clpipe.base.reading import check_input
from clpipe.base.text import whole_number
from clpipe.base.url_text import is_url, local, local_path

F = TypeVar("F", bound=Callable[..., Any])

# The headings in the help of commands with many options.
HEADINGS = ("Camera", "Chain", "Renders", "Pictures", "Clips", "Truth", "Inputs", "Batches")


class Option(click.Option):
    """An option with one of the :data:`HEADINGS`; "+" marks what brief help also shows."""

    def __init__(self, *arguments: Any, heading: str = "Batches", **others: Any) -> None:
        super().__init__(*arguments, **others)
        self.heading = heading


class Command(click.Command):
    """A command that rejects an option that is repeated but takes only one value.

    If a missing input follows the value of an option, the message explains how to pass several
    values to that option.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta[ARGUMENTS] = tuple(args)
        with self._with_hint(ctx):
            return self._parse(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        with self._with_hint(ctx):
            return super().invoke(ctx)

    @contextmanager
    def _with_hint(self, ctx: click.Context) -> Iterator[None]:
        try:
            yield
        except MissingError as error:
            hint = several_values_hint(self.get_params(ctx), ctx.meta[ARGUMENTS], error.name)
            raise RequestError(f"{error}{hint}") from None

    def _parse(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not ctx.resilient_parsing:
            parsed = self.make_parser(ctx).parse_args(list(args))[2]
            options = (each for each in parsed if isinstance(each, click.Option))
            for option in options:
                takes_one_value = not (option.multiple or option.is_flag)
                if takes_one_value and parsed.count(option) > 1:
                    raise RequestError(
                        f"{option.opts[-1]}: found {parsed.count(option)} times, but it takes only "
                        "one value; use it once"
                    )
        return super().parse_args(ctx, args)


def several_values_hint(
    options: Sequence[click.Parameter], arguments: Sequence[str], missing: str
) -> str:
    """Return how to pass several values to the option before a missing input, or "".

    >>> several_values_hint([click.Option(["--skip"], multiple=True)], ["--skip", "a", "b"], "b")
    ". To give --skip several values, use --skip a --skip b; for one with spaces, --skip 'a b'"
    """
    index = arguments.index(missing) - 2 if missing in arguments else -1
    named = {name: option for option in options for name in option.opts}
    option = named.get(arguments[index]) if index >= 0 else None
    if not isinstance(option, click.Option) or option.is_flag:
        return ""
    values = [arguments[index + 1]]
    for value in arguments[index + 2 :]:
        if value.startswith("-") or os.path.exists(value):
            break
        values.append(value)
    name = arguments[index]
    quoted = f"{name} '{' '.join(values)}'"
    if "," in (option.metavar or ""):
        return f". To give {name} several values, use {name} {','.join(values)}"
    if option.multiple:
        repeated = " ".join(f"{name} {value}" for value in values)
        return f". To give {name} several values, use {repeated}; for one with spaces, {quoted}"
    is_text = isinstance(option.type, click.types.StringParamType)
    return f". For a value with spaces, use {quoted}" if is_text else f". {name} takes one value"


class GroupedCommand(Command):
    """A command with options in groups: --help shows the usual ones, --help-all all of them."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        help_all = click.Option(
            ["--help-all"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=self._show_all,
            help="Show all options and exit.",
        )
        return [*super().get_params(ctx), help_all]

    def _show_all(self, ctx: click.Context, _: click.Parameter, is_set: bool) -> None:
        if is_set and not ctx.resilient_parsing:
            ctx.meta[ALL] = True
            click.echo(self.get_help(ctx), color=ctx.color)
            ctx.exit()

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        show_all = ctx.meta.get(ALL, False)
        groups: dict[str, list[tuple[str, str]]] = {title: [] for title in HEADINGS}
        for option in self.get_params(ctx):
            heading, record = getattr(option, "heading", "Batches"), option.get_help_record(ctx)
            is_shown = show_all or heading.startswith("+") or option.is_eager
            if record and is_shown and isinstance(option, click.Option):
                text = record[1] if show_all else brief(record[1])
                groups[heading.removeprefix("+")].append((record[0], text))
        for title, rows in groups.items():
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def brief(text: str) -> str:
    """Return the first clause of a help text, with the default or "required".

    >>> brief("A stage, whole; may be repeated. Others follow. [default: a; else b]")
    'A stage, whole. [default: a]'
    >>> brief("The folder; it is made.  [required]")
    'The folder. [required]'
    """
    first = re.split(r"[.;:](?=\s|$)", text)[0]
    end = re.search(r"\[(default: [^];]+|required)", text)
    return f"{first}.{f' [{end[1]}]' if end else ''}"


ALL = "clpipe.help_all"  # key in a context's meta: whether to show every option
ARGUMENTS = "clpipe.arguments"  # key in a context's meta: the command line's arguments

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")

json_lines_option = click.option(
    "--json-lines",
    is_flag=True,
    help="Print the log on stdout for programs, one line for the start, each image and the end.",
)


class ExistingPath(click.Path):
    """A file or directory to read. It must exist."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not (ctx and ctx.resilient_parsing):
            value = str(local_path(param.opts[-1] if param else "input", value))
            check_input(Path(value))
        return super().convert(value, param, ctx)


EXISTING = ExistingPath(path_type=Path)


class Sides(click.ParamType[tuple[int, int]]):
    """The width and height of a picture, as WIDTHxHEIGHT in px.

    Args:
        least: the shortest side, px.
        most: the longest side, px.
    """

    name = "text"

    def __init__(self, least: int, most: int) -> None:
        self._limits = least, most

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        least, most = self._limits
        width, height = map(whole_number, str(value).partition("x")[::2])
        if not least <= min(width, height) <= max(width, height) <= most:
            raise RequestError(
                f"--size: found {value!r}; expected WIDTHxHEIGHT, such as 640x480, with each side "
                f"from {least} to {most} px"
            )
        return width, height


class OutputPath(click.Path):
    """A file or directory to write to. Only ``clpipe run`` accepts a URL.

    An empty path is rejected, because it would be the working directory.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        name = param.opts[-1] if param else "output"
        if not value:
            raise RequestError(f"{name}: found an empty name; name a file or directory")
        value = local(value)
        if is_url(value) and ctx:
            if ctx.info_name == "run":
                return value
            raise RequestError(
                f"{name}: found the URL {value}, but only clpipe run writes to URLs; name a "
                "local path"
            )
        return super().convert(value, param, ctx)


def output_option(
    metavar: str, text: str, required: bool = True, multiple: bool = False
) -> Callable[[F], F]:
    """Return the option -o, with ``text`` as its help."""
    return click.option(
        "-o",
        "--output",
        "outputs" if multiple else "output",
        cls=Option,
        heading="+Pictures",
        required=required,
        multiple=multiple,
        type=OutputPath(path_type=Path),
        metavar=metavar,
        help=text,
    )


def _set_log_level(_context: click.Context, _option: click.Parameter, is_quiet: bool) -> bool:
    if is_quiet:
        logging.getLogger("clpipe").setLevel(logging.WARNING)
    return is_quiet


quiet_option = click.option(
    "--quiet", is_flag=True, callback=_set_log_level, help="Print failures only."
)


def options_on_command_line() -> dict[str, str]:
    """Return the options that are set on the command line, by parameter name."""
    context = click.get_current_context()
    return {
        str(parameter.name): parameter.opts[0]
        for parameter in context.command.params
        if context.get_parameter_source(str(parameter.name)) is not ParameterSource.DEFAULT
    }
