"""The class of all commands, and options that several share.

Options that need the stages are in chain_options.
"""

from pathlib import Path

import click
from click.core import ParameterSource

from clpipe.base.errors import RequestError
from clpipe.images.dump import TYPES


class Command(click.Command):
    """Refuses an option that is given twice and can hold but one value."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if not ctx.resilient_parsing:
            given = self.make_parser(ctx).parse_args(list(args))[2]
            options = (each for each in given if isinstance(each, click.Option))
            for option in options:
                holds_one = not (option.multiple or option.is_flag)
                if holds_one and given.count(option) > 1:
                    raise RequestError(
                        f"{option.opts[-1]}: it is given {given.count(option)} times, but holds "
                        "one value; give it once"
                    )
        return super().parse_args(ctx, args)


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")

device_option = click.option(
    "--device",
    "selector",
    metavar="SEL",
    help="An index or a part of a name from 'clpipe devices', or numpy.",
)

stage_file_option = click.option(
    "--stage-file",
    "stage_files",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE.py",
    help="Load a stage of your own; may be repeated.",
)

raw_size_option = click.option(
    "--raw-size", metavar="WxH", help="Width and height of headerless dumps (.raw)."
)

raw_type_option = click.option(
    "--raw-type", type=click.Choice(list(TYPES)), help="How headerless dumps store a sample."
)


def options_set() -> dict[str, str]:
    """The options that are set on the command line, by the names of their parameters."""
    context = click.get_current_context()
    return {
        str(parameter.name): parameter.opts[0]
        for parameter in context.command.params
        if context.get_parameter_source(str(parameter.name)) is not ParameterSource.DEFAULT
    }
