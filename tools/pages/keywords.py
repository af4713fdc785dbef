"""Write the parts of the Python API's source that depend on stages and options.

    tools/run pages keywords

These are clpipe/chain/keywords.pyi, for editors and type checkers, and the arguments in the
docstring of ``clpipe.run``. Run this tool again after you have changed a parameter or an option; a
test compares both files with its output.
"""

import inspect
import re
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from subprocess import PIPE
from typing import Any

from pydantic import BaseModel

from clpipe.batch.api import run
from clpipe.chain.keys import CODE, KEYS, Key
from clpipe.chain.methods import TABLE_MODELS
from clpipe.chain.options import OPTIONS
from clpipe.chain.registry import all_stages
from tools import ROOT
from tools.shared.options import parser_of

PATH = ROOT / "clpipe" / "chain" / "keywords.pyi"
API = ROOT / "clpipe" / "batch" / "api.py"

START = '''"""Keywords of the Python API: the tables and keys of a configuration, with their types.

Written by ``tools/run pages keywords`` from the stages that clpipe has. Numbers may be NumPy's, and
a value may be a draw, such as ``{"uniform": [0, 1]}``.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

import numpy as np

Draw = Mapping[str, Any]
Flag = bool | Draw
Number = float | np.floating[Any] | np.integer[Any] | Draw
Whole = int | np.integer[Any] | Draw
Text = str | Draw
Several = Sequence[Any] | np.ndarray[Any, Any] | Draw
'''

NAMES = {"number": "Number", "integer": "Whole", "string": "Text", "boolean": "Flag"}


def types_of(schema: Mapping[str, Any]) -> set[str]:
    """Return the types of a value from its JSON schema."""
    if "anyOf" in schema:
        return set().union(*map(types_of, schema["anyOf"]))
    if "enum" in schema:
        return {f"Literal[{', '.join(map(repr, schema['enum']))}]", "Draw"}
    kind = schema.get("type")
    return set() if kind == "null" else {NAMES.get(kind or "", "Several")}


def fields_of(*models: type[BaseModel]) -> dict[str, set[str]]:
    """Return the types of each parameter of several models."""
    fields: dict[str, set[str]] = {}
    for model in models:
        for name, schema in model.model_json_schema().get("properties", {}).items():
            fields.setdefault(name, set()).update(types_of(schema))
    return fields


def class_of(name: str, fields: Mapping[str, set[str]]) -> str:
    """Return a TypedDict whose keys are all optional."""
    lines = [f"    {key}: {' | '.join(sorted(types))}" for key, types in fields.items()]
    return "\n".join([f"class {name}(TypedDict, total=False):", *lines])


def text_of() -> str:
    """Return the formatted stub file."""
    parts, tables = [START], {}
    for name, stage in all_stages().items():
        if stage.folder is None:
            tables[name] = name.title().replace("_", "")
            chosen = types_of({"enum": [method.method for method in stage.methods]})
            parts.append(class_of(tables[name], {"method": chosen, **fields_of(*stage.methods)}))
    for name, model in TABLE_MODELS.items():
        tables[name] = model.__name__
        parts.append(class_of(tables[name], fields_of(model)))
    kinds = {int: "Whole", str: "Text", float: "Number", list: "Sequence[str]"}
    plain = {name: {kinds[key.type_]} for name, key in KEYS.items() if name != CODE}
    fields = plain | {name: {title} for name, title in tables.items()}
    parts.append(class_of("Keywords", fields))
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(PATH), "-"]
    written = "\n\n".join(parts) + "\n"
    return subprocess.run(command, input=written, stdout=PIPE, text=True, check=True).stdout


def argument_of(key: Key) -> str:
    """Return the entry of an option in a docstring."""
    text = key.text if key.text[1].isupper() else key.text[0].lower() + key.text[1:]
    listed = ", ".join(f'"{name}"' for name in key.choices)
    choices = f" The choices are {listed}." if listed else ""
    default = f" None is {key.default_text}." if key.default_text else ""
    named = re.sub(
        r"--([a-z-]+)",
        lambda match: f"``{match[1].replace('-', '_')}``",
        f"{key.name}: {text}{choices}{default}",
    )
    return textwrap.fill(named, 100, initial_indent=" " * 8, subsequent_indent=" " * 12)


def api_text() -> str:
    """Return the module of ``clpipe.run`` with the arguments in its docstring."""
    names = [name for name in inspect.signature(run).parameters if name != "settings"]
    before, start, rest = API.read_text("utf-8").partition("    Args:\n")
    _, end, after = rest.partition("        **settings:")
    arguments = "\n".join(argument_of(OPTIONS[name]) for name in names)
    return f"{before}{start}{arguments}\n{end}{after}"


def main() -> None:
    """Write both files."""
    parser_of(__doc__).parse_args()
    for path, text in ((PATH, text_of()), (API, api_text())):
        path.write_text(text, "utf-8")
        print(path.relative_to(ROOT))


if __name__ == "__main__":
    main()
