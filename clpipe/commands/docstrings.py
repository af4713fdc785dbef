"""Read docstrings from source, because importing a module can take half a second."""

import ast
from pathlib import Path


def docstring_of(module: str, function: str) -> str:
    """Return the docstring of a function.

    Args:
        module: the name of the module inside the package, such as "batch.api".
        function: the name of the function, which the module defines.
    """
    path = Path(__file__).parents[1].joinpath(*module.split(".")).with_suffix(".py")
    nodes = ast.parse(path.read_text("utf-8")).body
    functions = (node for node in nodes if isinstance(node, ast.FunctionDef))
    found = next(node for node in functions if node.name == function)
    return ast.get_docstring(found) or ""
