"""Methods outside a chain: their variants, and their references on a single image."""

import typing
from collections.abc import Iterator, Mapping
from typing import Any, get_args, get_origin

from clpipe.base.types import Floats
from clpipe.camera.profile import DEFAULT_CAMERA, load_camera
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.reference.random import stream_of
from clpipe.stage.context import Context, ReferenceContext
from clpipe.stage.method import Method
from clpipe.stage.passes import NoiseScope


def variants(method: type[Method]) -> Iterator[dict[str, Any]]:
    """Return parameters for each variant of a method that is compiled differently.

    The first variant has the defaults. Then follow each other choice of a structural parameter, and
    the method's other examples. CFA patterns are not variants here, since they are combined with
    every variant.
    """
    yield {}
    for name, field in method.model_fields.items():
        extra: Any = field.json_schema_extra
        choices = get_args(field.annotation)
        is_choice = get_origin(field.annotation) is typing.Literal and choices != PATTERNS
        if extra["structural"] and is_choice:
            yield from ({name: choice} for choice in choices if choice != field.default)
    yield from map(dict, method.other_examples)


def variant_label(method: type[Method], values: Mapping[str, Any]) -> str:
    """Return the name of a method with the parameters that differ from their defaults."""
    return " ".join([method.method, *(f"{name}={value}" for name, value in values.items())])


def run_reference(
    method: Method, image: Floats, iso: float = 100, pattern: Pattern = "RGGB"
) -> Floats:
    """Run the reference of a method on an image of the default camera, for examples.

    The noise is drawn for the image key "".
    """
    context = Context(load_camera(DEFAULT_CAMERA), iso, pattern)
    resolved = method.resolve(context)
    stream = {scope: stream_of(scope.value, resolved.method) for scope in NoiseScope}
    return resolved.reference(image, ReferenceContext(context, stream, {}))
