"""Draw the pictures of docs/architecture.md from the code: packages and a chain's launches.

Run this again after packages or launches have changed. A test compares the pictures with the code.
"""

import ast
import re
import textwrap
import tomllib
from collections.abc import Iterator, Sequence
from itertools import chain

import grimp

from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings
from clpipe.commands.plan import plan_record
from clpipe.engine.plan import make_plan
from tools import ROOT
from tools.shared.drawing import box, svg, text
from tools.shared.options import parser_of

DOCS = ROOT / "docs"
STYLE = """<style>
text { font: 13px sans-serif; fill: #24292e; dominant-baseline: middle; }
text.pale { fill: #5d676f; } .name { font: 600 13px monospace; } .middle { text-anchor: middle; }
.paper { fill: #fcfcfb; } .band { fill: #f0f1ef; } .line { fill: #c6ccd1; } .dot { fill: #00796b; }
.rgb { fill: #a9c8ea; } .mosaic { fill: #b5d9b2; } .ycbcr { fill: #f0cd97; }
.other { fill: #d5cce4; }
@media (prefers-color-scheme: dark) {
text { fill: #e4e6e8; } text.pale { fill: #a0a8b0; }
.paper { fill: #1f2227; } .band { fill: #282c32; } .line { fill: #49515a; } .dot { fill: #4db6ac; }
.rgb { fill: #34597f; } .mosaic { fill: #37653a; } .ycbcr { fill: #7d591f; }
.other { fill: #5c4a78; }
}
</style>
"""


def layers() -> list[list[str]]:
    """Return the packages of each layer, highest first, from import-linter's contract."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    (layers,) = (each["layers"] for each in settings["contracts"] if each["type"] == "layers")
    return [layer.split(" | ") for layer in layers]


def summary_of(package: str) -> str:
    """Return a package's docstring up to its first colon, semicolon or full stop."""
    folder = ROOT / "clpipe" / package
    path = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    docstring = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
    return re.split(r"[:;.](?:\s|$)", " ".join(docstring.replace("``", "").split()), maxsplit=1)[0]


def imports() -> set[tuple[str, str]]:
    """Return pairs of packages where the first imports the second at run time."""
    graph = grimp.build_graph("clpipe", exclude_type_checking_imports=True, cache_dir=None)
    return {
        (one.split(".")[1], two.split(".")[1])
        for one in graph.modules
        for two in graph.find_modules_directly_imported_by(one)
        if "." in one and "." in two
    }


def packages_picture() -> str:
    """Draw the import matrix of the packages, layer by layer: all dots are on one side."""
    names, pairs = list(chain.from_iterable(layers())), imports()
    left, top, step = 384, 92, 22
    width, height = left + step * len(names) + 16, top + step * len(names) + 12
    parts = [text(12, 28, "A dot: the package in that row imports the one in that column.", "pale")]
    row = 0
    for number, layer in enumerate(layers()):
        if number % 2 == 0:
            parts.append(box(0, top + row * step, width, step * len(layer), "band"))
        row += len(layer)
    for i, name in enumerate(names):
        x, y = left + (i + 0.5) * step, top + (i + 0.5) * step
        turned = f' transform="rotate(-60 {x:g} {top - 8})"'
        parts += [
            text(12, y, name, "name"),
            text(96, y, summary_of(name), "pale"),
            text(x, top - 8, name, "pale", turned),
            box(x - 4, y - 4, 8, 8, "line"),
        ]
        parts += [
            f'<circle cx="{left + (j + 0.5) * step:g}" cy="{y:g}" r="5" class="dot">'
            f"<title>{name} imports {other}</title></circle>"
            for j, other in enumerate(names)
            if (name, other) in pairs and name != other
        ]
    return svg(width, height, STYLE, parts)


def images_of(text: str) -> list[tuple[str, tuple[int, ...]]]:
    """Parse the kinds and slots of images, as in ``mosaic in 3; ycbcr in 1,2,4``."""
    found = re.findall(r"(\w+) in ([\d,]+)", text)
    return [(kind, tuple(map(int, slots.split(",")))) for kind, slots in found]


def lifetimes(launches: Sequence[dict[str, str]]) -> Iterator[tuple[str, int, int, int]]:
    """Yield for each plane its kind, its slot, the launch that writes it, and its last reader."""
    for written, launch in enumerate(launches):
        for kind, slots in images_of(launch["writes"]):
            last = written
            for number in range(written + 1, len(launches)):
                if (kind, slots) in images_of(launches[number]["reads"]):
                    last = number
                if set(slots) & {s for _, x in images_of(launches[number]["writes"]) for s in x}:
                    break
            yield from ((kind, slot, written, last) for slot in slots)


def launches_picture() -> str:
    """Draw the launches of the default chain, and the lifetime of each slot's images."""
    plan = plan_record(make_plan(make_chain(Settings())))
    launches, slots = plan["launches"], plan["slots"]
    left, top, step = 476, 62, 46
    width = left + slots * step + 14
    stages = [textwrap.wrap(launch["stages"].replace(",", " \u2192"), 62) for launch in launches]
    tops = [top]
    for lines in stages:
        tops.append(tops[-1] + 54 + 18 * len(lines))
    parts = [text(left + slots * step / 2, 20, "slots: buffers of one plane", "pale middle")]
    parts += [text(left + (s + 0.5) * step, 44, str(s), "name middle") for s in range(slots)]
    for number, (launch, lines) in enumerate(zip(launches, stages, strict=True)):
        y = tops[number]
        if number % 2 == 0:
            parts.append(box(0, y, width, tops[number + 1] - y, "band"))
        parts += [
            text(14, y + 18, f"{number + 1}", "pale"),
            text(36, y + 18, launch["launch"], "name"),
            text(36, y + 38, reason_of(launch), "pale"),
            *(text(36, y + 58 + 18 * i, line) for i, line in enumerate(lines)),
        ]
    for kind, slot, written, last in lifetimes(launches):
        begin, end = tops[written] + 14, tops[last + 1] - 14
        if last > written:  # from the end of the writing launch to the end of the last reader
            begin, end = tops[written + 1] - 22, tops[last + 1] - 26
        x = left + slot * step
        colour = kind if kind in ("rgb", "mosaic", "ycbcr") else "other"
        middle = f"{x + step / 2:g} {(begin + end) / 2:g}"
        parts.append(box(x + 8, begin, step - 16, end - begin, colour, ' rx="5"'))
        turned = f' transform="rotate(-90 {middle})"'
        parts.append(text(x + step / 2, (begin + end) / 2, kind, "middle", turned))
    bottom = tops[-1]
    parts.append(text(36, bottom + 20, f"the result: {launches[-1]['writes']}", "pale"))
    return svg(width, bottom + 40, STYLE, parts)


def reason_of(launch: dict[str, str]) -> str:
    """Return a phrase that states why a launch starts."""
    stage, _, rest = launch["opened_by"].partition(": ")
    if rest:
        return f"opened by {stage}, a {rest.replace(', ', ' of ')}"
    return f"from the {launch['reads']}" if launch["reads"] else stage


PICTURES = {"packages.svg": packages_picture, "launches.svg": launches_picture}


def main() -> None:
    """Write the pictures."""
    parser_of(__doc__).parse_args()
    for name, picture in PICTURES.items():
        (DOCS / name).write_text(picture(), "utf-8")


if __name__ == "__main__":
    main()
