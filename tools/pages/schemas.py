"""Write the JSON Schemas of clpipe's files and of ``--json`` into clpipe/schemas.

    tools/run pages schemas

They are made from the models in clpipe/outputs/schema.py and clpipe/commands/schema.py.
"""

import json
from typing import Any

from pydantic import TypeAdapter

from clpipe.commands.schema import KEYS, model_of
from clpipe.outputs.schema import FILES
from tools import ROOT
from tools.shared.options import parser_of

FOLDER = ROOT / "clpipe" / "schemas"
DIALECT = {"$schema": "https://json-schema.org/draft/2020-12/schema"}


def schemas() -> dict[str, dict[str, Any]]:
    """Return all schemas, by the names of their files without extension."""
    commands = {f"command.{name.replace(' ', '.')}": model_of(name) for name in KEYS}
    models = FILES | commands
    return {name: {**DIALECT, **TypeAdapter(model).json_schema()} for name, model in models.items()}


def text_of(schema: dict[str, Any]) -> str:
    """Return the text of a schema's file."""
    return json.dumps(schema, indent=1) + "\n"


def main() -> None:
    """Write the files."""
    parser_of(__doc__).parse_args()
    FOLDER.mkdir(exist_ok=True)
    for name, schema in schemas().items():
        (FOLDER / f"{name}.json").write_text(text_of(schema), "utf-8")
    print(FOLDER.relative_to(ROOT))


if __name__ == "__main__":
    main()
