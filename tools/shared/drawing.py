"""Drawings as SVG, readable on pages of any colour."""

from collections.abc import Sequence
from html import escape


def svg(width: int, height: int, style: str, parts: Sequence[str], label: str = "") -> str:
    """Return an SVG with its own background, of the class "paper".

    Args:
        width: its width in px.
        height: its height in px.
        style: an element with the style of all classes.
        parts: its elements.
        label: a description for readers who do not see it.
    """
    frame = f'<rect width="{width}" height="{height}" rx="6" class="paper"/>'
    size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    described = f' role="img" aria-label="{escape(label)}"' if label else ""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}{described}>'
    return "\n".join([head, style + frame, *parts, "</svg>"]) + "\n"


def text(x: float, y: float, line: str, kind: str = "", more: str = "") -> str:
    """Return a line of text, vertically centred on y."""
    return f'<text x="{x:g}" y="{y:g}" class="{kind}"{more}>{escape(line)}</text>'


def box(x: float, y: float, width: float, height: float, colour: str, more: str = "") -> str:
    """Return a rectangle of a class, which sets its colour."""
    place = f'x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}"'
    return f'<rect {place} class="{colour}"{more}/>'


def upright(x: float, top: float, bottom: float, kind: str) -> str:
    """Return a vertical line of a class."""
    return f'<line class="{kind}" x1="{x:.1f}" x2="{x:.1f}" y1="{top:g}" y2="{bottom:g}"/>'
