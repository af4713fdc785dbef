"""Generates pages of the site from the stages, cameras, configurations and commands.

MkDocs calls this hook. :func:`pages` works without MkDocs.
"""

import base64
import json
import re
from collections.abc import Sequence
from inspect import cleandoc
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from clpipe.base.vocabulary import DISPOSITIONS, Vocabulary
from clpipe.chain.registry import all_stages
from clpipe.commands.main import COMMANDS, main, summary
from clpipe.images.colour_names import ALIASES, DATA, DECODERS, LINEAR, PRIMARIES
from clpipe.images.vocabularies import CLIP, DNG, JPEG, LAYERS, OPENEXR, PNG, TIFF
from clpipe.inputs.annotation_keys import BOP, COCO, KITTI
from clpipe.inputs.camera_keys import COLMAP, TRANSFORMS
from clpipe.stage import Method
from clpipe.stages import DEFAULT_CHAIN
from tools import ROOT
from tools.shared.tables import markdown

NOTEBOOK = "first_steps"
# Units of a camera's values, and those that its table does not list.
UNITS = dict.fromkeys(("black_level", "white_level"), "DN")
UNITS |= dict.fromkeys(("full_well", "dsnu", "hot_pixel_level"), "e-")
NOT_LISTED = ("name", "make", "model", "aliases", "iso_range", "noise", "sources")
VOCABULARIES = (OPENEXR, LAYERS, PNG, TIFF, JPEG, DNG, CLIP, TRANSFORMS, COLMAP, COCO, BOP, KITTI)


def pages() -> dict[str, str | bytes]:
    """Return the contents of generated files by their paths in docs/."""
    return {
        "stages.md": stages_page(),
        "cameras.md": cameras_page(),
        "configurations.md": configurations_page(),
        "cli.md": cli_page(),
        "statements.md": statements_page(),
        "changelog.md": (ROOT / "CHANGELOG.md").read_text("utf-8").replace("](docs/", "]("),
        "security.md": (ROOT / "SECURITY.md").read_text("utf-8"),
        "contributing.md": (ROOT / "CONTRIBUTING.md").read_text("utf-8").replace("](docs/", "]("),
        **{f"schemas/{p.name}": p.read_bytes() for p in (ROOT / "clpipe/schemas").iterdir()},
        **notebook_files(ROOT / "docs" / f"{NOTEBOOK}.ipynb"),
    }


def json_of(*command: str) -> Any:
    """Run a command of clpipe with --json, and return the list that it prints."""
    result = CliRunner().invoke(main, [*command, "--json"], catch_exceptions=False)
    if result.exit_code:
        raise RuntimeError(result.output)
    return json.loads(result.output)[command[0]]


def table(headings: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Format a table in Markdown, with a line break."""
    return markdown(headings, rows) + "\n"


def code(text: object) -> str:
    """Format text as code; empty text stays empty."""
    return f"`{text}`" if text else ""


def prose(text: str) -> str:
    """Convert a docstring: without doctests, and with reStructuredText roles as plain code."""
    text = re.sub(r"\n\s*>>>.*?(?=\n\s*\n|\Z)", "", cleandoc(text), flags=re.DOTALL)
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    return text.replace("``", "`").strip()


def sources(method: type[Method]) -> str:
    """List the files of a method: its declaration with the NumPy reference, and its kernel."""
    files = [f"{method.__module__.replace('.', '/')}.py"]
    if not (ROOT / files[0]).is_file():
        files = [f"{method.__module__.replace('.', '/')}/__init__.py"]
    if method.kernel:
        files.append(f"kernels/{method.kernel}.cl")
    for file in files:
        if not (ROOT / file).is_file():
            raise FileNotFoundError(file)
    return ", ".join(map(code, files))


def statements_page() -> str:
    """Generate the page of what files of other programs state, and what becomes of it."""
    rows: list[list[object]] = [[word, meaning] for word, meaning in DISPOSITIONS.items()]
    parts = [
        "# Statements in files\n\n"
        "This page is generated from the tables that the readers use. It lists what the files of "
        "other programs can state, and what clpipe does with it. If a file states something else "
        "whose name is like those of colours, lenses or time, a warning names it.\n\n"
        + table(["in the tables below", "means"], rows)
    ]
    for vocabulary in VOCABULARIES:
        parts.append(f"## {vocabulary.format}\n\nSource: {vocabulary.source}.\n\n")
        parts.append(table(["", "what is stated", "names"], _statement_rows(vocabulary)))
    encodings = ", ".join(map(code, [LINEAR, *DECODERS]))
    colours = ", ".join(map(code, PRIMARIES))
    parts.append(
        "## Names of colour spaces in OpenEXR\n\nA name of the Color Interop Forum consists of an "
        f"encoding ({encodings}), primaries ({colours}), and `scene` or `display`, such as "
        f"`lin_ap1_scene`. Names of values that are not colours are {', '.join(map(code, DATA))}. "
        "Other programs' names:\n\n"
    )
    parts.append(table(["name", "meaning"], [[code(a), code(b)] for a, b in ALIASES.items()]))
    return "\n".join(parts)


def _statement_rows(vocabulary: Vocabulary) -> list[list[object]]:
    groups: dict[tuple[str, str], list[str]] = {}
    for each in vocabulary.statements.values():
        groups.setdefault((each.disposition, each.meaning), []).append(code(each.name))
    return [[word, meaning, ", ".join(names)] for (word, meaning), names in groups.items()]


def stages_page() -> str:
    """Generate the page of all stages with their methods and parameters."""
    records, rows = json_of("stages"), []
    for record in records:
        name = record["name"]
        link = f"[`{name}`](#{name})" + ("" if name in DEFAULT_CHAIN else " \\*")
        methods = ", ".join(code(method["name"]) for method in record["methods"])
        rows.append([link, kinds(record), methods, record["summary"]])
    parts = [
        "# Stages and methods\n\n"
        "This page is generated from the declarations of the stages. `clpipe stages NAME` prints "
        "one of them. With `--camera` and `--iso`, it prints the values of automatic parameters. "
        "The first method of a stage is its default. To set a parameter, use "
        "`--set STAGE.PARAMETER=VALUE` or the table `[STAGE]` of a configuration. To choose a "
        "method, use `--set STAGE.method=NAME`. Stages are listed in the order of the default "
        "chain. Those after `picture_noise` are not part of it.\n\n"
        "The kinds of image are:\n\n"
        "- *rgb*: linear, 1 = full scale of the sensor at EV 0\n"
        "- *mosaic*: one plane of signal, 0 = black level, 1 = white level\n"
        "- *raw*: the mosaic in DN\n"
        "- *display*: 0 to 1, encoded for a screen\n",
        table(["stage", "image", "methods", "what it does"], rows),
        "\\* not in the default chain\n",
        *(stage_part(record) for record in records),
    ]
    return "\n".join(parts)


def kinds(record: dict[str, Any]) -> str:
    """Format the kinds of image that a stage reads and writes."""
    reads, writes = record["reads"], record["writes"]
    return reads if reads == writes else f"{reads} → {writes}"


def stage_part(record: dict[str, Any]) -> str:
    """Generate the section of a stage."""
    stage = all_stages()[record["name"]]
    parts = [f"## {stage.name}\n", f"{record['summary']} Image: {kinds(record)}.\n"]
    for each in record["methods"]:
        parts.append(f"### {each['name']} {{ #{stage.name}-{each['name']} }}\n")
        parts.append(f"{sentence(each['summary'])}\n")
        method = stage.by_name[each["name"]]
        if docstring := method.__dict__.get("__doc__"):
            text = prose(docstring)
            if text.strip(" .").lower() != each["summary"].strip(" .").lower():
                parts.append(f"{text}\n")
        if each["parameters"]:
            rows = [
                [code(p["name"]), p["default"], p["unit"], p["allowed"], p["text"]]
                for p in each["parameters"]
            ]
            parts.append(table(["parameter", "default", "unit", "allowed", "meaning"], rows))
        parts.append(f"Source: {sources(method)}\n")
    return "\n".join(parts)


def sentence(text: str) -> str:
    """Format a summary as a sentence."""
    return text[:1].upper() + text[1:].rstrip(".") + "."


def figure(value: object) -> str:
    """Format a number with four digits, or None as a dash."""
    if value is None:
        return "-"
    if isinstance(value, list):
        return ", ".join(map(figure, value))
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value)


def cameras_page() -> str:
    """Generate the page of built-in cameras: noise at every measured ISO, and sources."""
    parts = [
        "# Cameras\n\n"
        "This page is generated from the built-in profiles. `clpipe cameras NAME` prints one of "
        "them. `clpipe cameras NAME --iso N` prints the noise at one ISO. "
        "[Noise and cameras](noise.md) explains the figures, and shows how to write your own "
        "profile.\n"
    ]
    for camera in json_of("cameras"):
        low, high = camera["iso_range"]
        make, model = camera["make"], camera["model"]
        title = model if model.startswith(make) else f"{make} {model}"
        also = f" ({', '.join(camera['aliases'])})" if camera["aliases"] else ""
        parts.append(f"## {camera['name']}\n\n{title}{also}, ISO {low:g} to {high:g}.\n")
        rows: list[list[object]] = [
            [code(key), figure(value), UNITS.get(key, "") if value is not None else ""]
            for key, value in camera.items()
            if key not in NOT_LISTED
        ]
        parts.append(table(["", "value", "unit"], rows))
        headings = ["ISO", "a", "b", "system_gain, DN/e-", "read_noise, e-", "adc_noise, DN"]
        headings += ["dark noise, DN", "row_noise, DN", "column_noise, DN"]
        rows = []
        for noise in camera["noise"]:
            signal, emva = noise["signal"], noise["emva1288"]
            values = [noise["iso"], signal["a"], signal["b"], *emva.values()]
            values += [noise["dark_noise"], noise["row_noise"], noise["column_noise"]]
            numbers = (figure(float(value)) for value in values)
            rows.append([text.replace("-", "\N{NON-BREAKING HYPHEN}") for text in numbers])
        parts.append(table(headings, rows))
        parts.append("Sources:\n")
        parts += [f"- `{key}`: {text}" for key, text in camera["sources"].items()]
        parts.append("")
    return "\n".join(parts)


def configurations_page() -> str:
    """Generate the page of built-in configurations."""
    parts = [
        "# Configurations\n\n"
        "These are the files of the built-in configurations. To use one, add `-c NAME`. For the "
        "format, see [Configuration and draws](configuration.md).\n"
    ]
    for path in sorted(ROOT.glob("clpipe/**/configs/*.toml")):
        parts.append(f"## {path.stem}\n\n```toml\n{path.read_text('utf-8')}```\n")
    return "\n".join(parts)


def cli_page() -> str:
    """Generate the page of the command line; mkdocs-click inserts the commands."""
    module = main.callback.__module__ if main.callback else ""
    listed = [[f"`clpipe {name}`", summary(name)] for name in COMMANDS]
    commands = table(["command", "what it does"], listed)
    return f"""# Command line

This page is generated from the program. `clpipe COMMAND --help` prints the same text. The help of
large commands shows only the most common options; `--help-all` shows all.

{commands}
| exit status | meaning |
|---|---|
| 0 | success |
| 1 | some images failed; the others are written |
| 2 | the request was wrong; nothing is written |
| 3 | there is no usable device |
| 130 | interrupted |

::: mkdocs-click
    :module: {module}
    :command: main
    :prog_name: clpipe
    :depth: 1
    :style: plain

::: mkdocs-click
    :module: clpipe.commands.cameras
    :command: import_command
    :prog_name: clpipe cameras import
    :depth: 2
    :style: plain
"""


def notebook_files(path: Path) -> dict[str, str | bytes]:
    """Convert a notebook with its outputs to a page and its pictures."""
    notebook = json.loads(path.read_text("utf-8"))
    name, parts, files = path.stem, [], {}
    for cell_number, each in enumerate(notebook["cells"]):
        source = "".join(each["source"])
        if each["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for number, output in enumerate(each["outputs"]):
            data = output.get("data", {})
            if "image/png" in data:
                picture = f"{name}_{cell_number}_{number}.png"
                files[picture] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![]({picture})")
            elif text := "".join(output.get("text", data.get("text/plain", ""))):
                parts.append(f"```text\n{text.rstrip()}\n```")
    return {f"{name}.md": "\n\n".join(parts) + "\n", **files}


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages. MkDocs calls this function."""
    from mkdocs.structure.files import File

    for path, content in pages().items():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Format roles and examples of commands as code. MkDocs calls this function."""
    if page.file.src_uri == "cli.md":
        html = re.sub(r"<p>(clpipe [^<]+)</p>", r"<pre><code>\1</code></pre>", html)
    return re.sub(r":\w+:<code>~?([^<]+)</code>", r"<code>\1</code>", html)
