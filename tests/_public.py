"""The public names: those of the package, and those of its rooms."""

import importlib

ROOMS = (
    "models",
    "focal",
    "io",
    "interop",
    "detect",
    "lines",
    "tracks",
    "correct",
    "scenes",
    "fit",
    "trust",
)

DOORS = {room: importlib.import_module(f"zoomjax.{room}") for room in (*ROOMS, "app")}

PUBLIC = {
    f"{room}.{name}": getattr(door, name)
    for room, door in DOORS.items()
    for name in door.__all__
    if callable(getattr(door, name))  # neither a module nor a constant
}
"""All of them: the package's own are those that every user needs."""

FUNCTIONS = {
    name.partition(".")[2]: thing
    for name, thing in PUBLIC.items()
    if not name.startswith(("io.", "detect.", "scenes.", "app."))  # of files and images
}
