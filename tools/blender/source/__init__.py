"""Develops each render of Blender with clpipe's camera simulation.

OpenCL never runs in Blender's process. Handlers write the Render Result as linear EXR, and
``clpipe run`` develops it in another process. When Blender renders from its window, handlers run in
the render thread. A timer loads the pictures in the main thread.
"""

import json
import os
import re
import textwrap
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from .development import Development, DevelopmentError, Render, Settings

CHOICES = json.loads(Path(__file__).with_name("choices.json").read_text("utf-8"))
IMAGE = "clpipe"  # the image that shows the latest picture
FOLDER = "clpipe"  # for the pictures, next to the render's own files
LINEAR = "linear"  # for the linear renders, in FOLDER
SPACE = "Linear Rec.709"  # the colour space that clpipe expects of an EXR
EXR = {
    "file_format": "OPEN_EXR",
    "color_mode": "RGB",
    "color_depth": "16",
    "exr_codec": "ZIP",
    "color_management": "OVERRIDE",
}
SECONDS = 0.25  # between two checks for developed pictures

# EXR attributes that differ in each render: the date, the render time and the memory used.
VOLATILE = re.compile(rb"(?:Date|RenderTime|Memory|cycles\.[^\0]*_time)\0string\0(.{4})", re.DOTALL)

development = Development()


class ClpipeSettings(bpy.types.PropertyGroup):
    """The settings of a scene."""

    enabled: BoolProperty(
        name="Develop Renders",
        description="Simulate a camera for each rendered frame, and write the developed picture",
        options=set(),
    )
    camera: StringProperty(
        name="Camera",
        description="The name of a camera or the path of a profile. Empty: the camera of the look",
        search=lambda _self, _context, _text: list(CHOICES["cameras"].items()),
        search_options={"SUGGESTION"},
        options=set(),
    )
    look: StringProperty(
        name="Look",
        description="The name or path of a configuration, which develops the raw",
        default=CHOICES["look"],
        search=lambda _self, _context, _text: CHOICES["looks"],
        search_options={"SUGGESTION"},
        options=set(),
    )
    iso: IntProperty(
        name="ISO",
        description="Sets the strength of noise and denoising",
        default=CHOICES["iso"],
        min=1,
        options=set(),
    )
    seed: IntProperty(
        name="Seed", description="Seed of the noise", default=CHOICES["seed"], min=0, options=set()
    )
    keep_raw: BoolProperty(
        name="Keep Raw", description="Also write the camera's raw as DNG", options=set()
    )


def settings_of(scene: Any) -> Settings:
    """The settings of a scene, with absolute paths."""
    own = scene.clpipe
    camera, look = (os.fspath(bpy.path.abspath(name)) for name in (own.camera, own.look))
    return Settings(camera, look, own.iso, own.seed, own.keep_raw)


@contextmanager
def temporary(thing: Any, values: Mapping[str, Any]) -> Iterator[None]:
    """Set attributes of a Blender object temporarily."""
    before = {name: getattr(thing, name) for name in values}
    try:
        for name, value in values.items():
            setattr(thing, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(thing, name, value)


@contextmanager
def linear_exr(scene: Any) -> Iterator[None]:
    """Make a scene write half EXR in linear Rec. 709, independently of its own output settings.

    Raises:
        DevelopmentError: the user's colour configuration has no such space.
    """
    image = scene.render.image_settings
    space = image.linear_colorspace_settings
    own = {"name": space.name} if image.color_management == "OVERRIDE" else {}
    media = {"media_type": "IMAGE"} if hasattr(image, "media_type") else {}  # from Blender 5.0 on
    with temporary(image, media | EXR), temporary(space, own):
        try:
            space.name = SPACE
        except TypeError:
            message = f"the OpenColorIO configuration has no colour space {SPACE}"
            raise DevelopmentError(message) from None
        yield


def zero_volatile(path: Path) -> None:
    """Zero attributes that differ in each render, because noise depends on the file's bytes."""
    with path.open("r+b") as file:
        head = bytearray(file.read(2**16))
        for found in VOLATILE.finditer(bytes(head)):
            end = found.end() + int.from_bytes(found[1], "little")
            head[found.end() : end] = re.sub(rb"\d", b"0", head[found.end() : end])
        file.seek(0)
        file.write(head)


def save_linear(scene: Any) -> Render:
    """Write the Render Result of a scene's frame as FOLDER/linear/NAME.exr, and return it.

    Raises:
        DevelopmentError: it has several views, or cannot be written.
    """
    if scene.render.use_multiview:
        raise DevelopmentError(
            "clpipe cannot develop a render with several views; turn Stereoscopy off"
        )
    with linear_exr(scene):
        own = Path(os.path.abspath(scene.render.frame_path(frame=scene.frame_current)))
        folder = own.parent / FOLDER
        path = folder / LINEAR / f"{own.name.removesuffix('.exr')}.exr"
        unfinished = path.with_name(f".{path.name}")  # clpipe may still be reading the previous one
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            bpy.data.images["Render Result"].save_render(str(unfinished), scene=scene)
            zero_volatile(unfinished)
            unfinished.replace(path)
        except OSError as error:
            raise DevelopmentError(f"{error.filename}: {error.strerror}") from None
        except RuntimeError as error:  # Blender's own errors
            raise DevelopmentError(str(error).strip().removeprefix("Error: ")) from None
    return Render(path, folder, settings_of(scene))


def show(picture: Path | None) -> None:
    """Load the latest picture, and show it in Image Editors that show the Render Result."""
    if picture is None:
        return
    image = bpy.data.images.get(IMAGE)
    if image is None:
        image = bpy.data.images.load(str(picture))
        image.name = IMAGE
    else:
        image.filepath = str(picture)
        image.reload()
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR" and not bpy.app.is_job_running("RENDER"):
                space = area.spaces.active
                if space.image is None or space.image.type == "RENDER_RESULT":
                    space.image = image


@persistent
def begin(_scene: Any, *_: Any) -> None:
    """Clear the message before a still or an animation."""
    development.message = ""


@persistent
def add_frame(scene: Any, *_: Any) -> None:
    """Add each rendered frame to the queue."""
    if not scene.clpipe.enabled:
        return
    try:
        development.add(save_linear(scene))
    except DevelopmentError as error:
        development.fail(str(error))
    if bpy.app.background:
        development.poll()


@persistent
def end(_scene: Any, *_: Any) -> None:
    """Finish after a still or an animation, also if it was cancelled."""
    if bpy.app.background:  # no timer runs, and Blender may quit at once
        show(development.finish())


def check_progress() -> float:
    """Show developed pictures, and return the seconds until the next check."""
    busy = len(development)
    show(development.poll())
    if busy != len(development):
        for window in bpy.context.window_manager.windows:
            for area in window.screen.areas:
                if area.type == "PROPERTIES":
                    area.tag_redraw()
    return SECONDS


class RENDER_PT_clpipe(bpy.types.Panel):  # noqa: N801 - Blender's naming convention
    """The panel in the output properties."""

    bl_label = "Camera Development"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "output"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012 - like Blender's own panels

    def draw_header(self, context: Any) -> None:
        self.layout.prop(context.scene.clpipe, "enabled", text="")

    def draw(self, context: Any) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.clpipe
        column = layout.column()
        column.active = settings.enabled
        for name in ("camera", "look", "iso", "seed", "keep_raw"):
            column.prop(settings, name)
        if waiting := len(development):
            layout.label(text=f"{waiting} to develop", icon="SORTTIME")
        if development.message:
            column = layout.column(align=True)
            column.alert = True
            width = context.region.width // 8  # a letter is about 8 pixels wide
            for number, line in enumerate(textwrap.wrap(development.message, max(width, 20))):
                column.label(text=line, icon="BLANK1" if number else "ERROR")


CLASSES = (ClpipeSettings, RENDER_PT_clpipe)
HANDLERS = {
    "render_init": begin,
    "render_post": add_frame,
    "render_complete": end,
    "render_cancel": end,
}


def register() -> None:
    """Register the classes and handlers when the extension is enabled."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.clpipe = PointerProperty(type=ClpipeSettings)
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    if not bpy.app.background:
        bpy.app.timers.register(check_progress, persistent=True)


def unregister() -> None:
    """Develop waiting renders and unregister, when the extension is disabled or Blender quits."""
    if bpy.app.timers.is_registered(check_progress):
        bpy.app.timers.unregister(check_progress)
    development.finish()
    for name, handler in HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    del bpy.types.Scene.clpipe
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
