"""Kernels over a stack: images or patches of one plan, side by side in one launch.

The body of such a kernel is the plain one's. What is a parameter there, and differs between the
members of a stack, is a number of a table here, with a row for each member; the third dimension of
the index space counts them. Of a buffer the table has the distance between members.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.engine.bindings import Buffer, ExtentNumber, Parameter, TileNumber
from clpipe.engine.members import Member

TABLE = "numbers"
BYTES = {"uchar": 1, "half": 2, "float": 4, "uint": 4, "int4": 16, "long4": 32}
AS_TYPE = {"uint": "{}", "int": "as_int({})", "float": "as_float({})"}


def element_of(parameter: Parameter) -> str | None:
    """The OpenCL type of what a parameter points to; None where it is a number."""
    type_, star, _ = parameter.declaration.partition("*")
    return type_.split()[-1] if star else None


def opening(parameters: Mapping[str, Parameter]) -> tuple[list[str], list[str]]:
    """The parameters that a stack's kernel has instead of the plain one's, and its first lines.

    Args:
        parameters: the plain kernel's, by their names in the text.
    """
    declared = [f"__global const uint *restrict {TABLE}"]
    lines = [f"{TABLE} += get_global_id(2) * {len(parameters)};"]
    for place, (name, parameter) in enumerate(parameters.items()):
        number = f"{TABLE}[{place}]"
        if element_of(parameter):
            declared.append(parameter.declaration)
            lines.append(f"{name} += get_global_id(2) * {number};")
        else:
            type_ = parameter.declaration.split()[0]
            lines.append(f"const {type_} {name} = {AS_TYPE[type_].format(number)};")
    return declared, lines


def arguments_of(
    parameters: Sequence[Parameter],
    level: int,
    buffers: Mapping[str, Any],
    strides: Mapping[str, int],
    members: Sequence[Member],
    table: Callable[[Array], Any],
    new_table: Callable[[Array], Any],
) -> list[Any]:
    """The arguments of a stack's kernel, in order.

    Args:
        parameters: the plain kernel's, in order.
        level: of its launch.
        buffers: by name.
        strides: bytes from a member to the next in each buffer.
        members: of the stack.
        table: gives a buffer that holds an array, which is used again for the same object.
        new_table: gives a new one.
    """
    numbers = np.zeros((len(members), len(parameters)), np.uint32)
    pointers = []
    for place, parameter in enumerate(parameters):
        match parameter.bound:
            case Buffer(name):
                pointers.append(buffers[name])
                element = element_of(parameter)
                assert element
                numbers[:, place] = strides[name] // BYTES[element]
            case ExtentNumber(name, larger):
                of = max(level - 1, 0) if larger else level
                numbers[:, place] = [member.extents[of].numbers[name] for member in members]
            case TileNumber():
                pass  # of each the first
            case value:
                found = [member.task.bind(value) for member in members]
                if isinstance(found[0], np.ndarray):
                    array, numbers[:, place] = side_by_side(found)
                    pointers.append((table if array is found[0] else new_table)(array))
                else:
                    numbers[:, place] = np.array(found, found[0].dtype).view(np.uint32)
    return [new_table(numbers), *pointers]


def side_by_side(arrays: Sequence[Array]) -> tuple[Array, int]:
    """Arrays one behind the other, and the elements from each to the next: 0 if all are one object.

    >>> side_by_side([np.array([1, 2, 3]), np.array([4])])[0].tolist()
    [1, 2, 3, 4, 0, 0]
    """
    first = arrays[0]
    if all(array is first for array in arrays):
        return first, 0
    longest = max(array.size for array in arrays)
    both = np.zeros((len(arrays), longest), first.dtype)
    for row, array in zip(both, arrays, strict=True):
        row[: array.size] = array.reshape(-1)
    return both.reshape(-1), longest
