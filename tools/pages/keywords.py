"""Write clpipe/chain/keywords.pyi, the types of the stages' parameters for editors and checkers.

    tools/run pages keywords

Run this tool again after you have changed a parameter; a test compares the file with its output.
"""

import subprocess
import sys
from collections.abc import Mapping
from subprocess import PIPE
from typing import Any

from pydantic import BaseModel

from clpipe.chain.keys import CODE, KEYS
from clpipe.chain.methods import TABLE_MODELS
from clpipe.chain.registry import all_stages
from tools import ROOT
from tools.shared.options import parser_of

PATH = ROOT / "clpipe" / "chain" / "keywords.pyi"

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
    plain["iso"] |= {"Text", "tuple[float, float]"}  # a range, such as "100..6400"
    fields = plain | {name: {title} for name, title in tables.items()}
    parts.append(class_of("Keywords", fields))
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(PATH), "-"]
    written = "\n\n".join(parts) + "\n"
    return subprocess.run(command, input=written, stdout=PIPE, text=True, check=True).stdout


def main() -> None:
    """Write the file."""
    parser_of(__doc__).parse_args()
    PATH.write_text(text_of(), "utf-8")
    print(PATH.relative_to(ROOT))


if __name__ == "__main__":
    main()
