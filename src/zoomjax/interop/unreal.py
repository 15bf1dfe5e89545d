"""Unreal Engine's .ulens: tables over focus and zoom of its Spherical lens model.

OpenCV's k1 k2 k3 p1 p2, for radii in focal lengths; Fx, Fy, Cx and Cy are shares of the image's width and
height. Zoom is the focal length in the lens's unit, focus one entry. Unreal takes the tables as linear
between entries, but eases the first and last interval: those are made short.
"""

import dataclasses
import json

import numpy as np

from ._documents import load_json
from ._pinhole import ROUNDED, Pinhole, Pinholes, contents, focal_px, formula, node_of, pinhole
from ._samples import distortions
from ._solve import same
from .base import Contents, Export, Import, Node, read_text, refuse_others
from .opentrackio import OpenTrackIO

_END = 0.01
"""Length of the first and last interval, as a share of their neighbours'."""

_SQUARE = 0.01
"""Share by which sensor and image may differ in shape: sizes are rounded."""

_TABLES = {
    "DistortionTable": "FocusEncoder, ZoomEncoder, K1, K2, K3, P1, P2",
    "FocalLengthTable": "FocusEncoder, ZoomEncoder, Fx, Fy",
    "ImageCenterTable": "FocusEncoder, ZoomEncoder, Cx, Cy",
    "NodalOffsetTable": "FocusEncoder, ZoomEncoder, Qx, Qy, Qz, Qw, Tx, Ty, Tz",
}


class Unreal(Pinholes):
    """Unreal's lens file exchange format."""

    name, tools, suffixes = "unreal", "Unreal Engine", (".ulens",)

    def forms(self, lens):
        """Three terms."""
        return (formula(lens, 3),)

    def notes(self, nodes: list[Node], job: Export) -> tuple[str, ...]:
        """The other way into Unreal, for lenses that it suits."""
        [form] = OpenTrackIO().forms(job.lens)
        if same(form, distortions(job.lens, np.asarray(job.lens.focal_range)[:1])[0]) is None:
            return ()
        return ("Unreal's reader of OpenTrackIO takes the lens without a refit.",)

    def interpolate(self, focal: np.ndarray, numbers: np.ndarray, at: float) -> np.ndarray:
        """Linear, but with a slope of 0 at both ends, as its automatic tangents have it."""
        i = int(np.clip(np.searchsorted(focal, at, side="right") - 1, 0, max(len(focal) - 2, 0)))
        if len(focal) < 2:
            return numbers[0]
        t = (at - focal[i]) / (focal[i + 1] - focal[i])
        rise = numbers[i + 1] - numbers[i]
        if i == 0:  # the slope is 0 at the start
            t = t * t * (2 - t)
        if i == len(focal) - 2 and i > 0:
            t = 1 - (1 - t) ** 2 * (1 + t)
        return numbers[i] + t * rise

    def spread(self, low: float, high: float, number: int) -> np.ndarray:
        """Geometric, with one more close to each end."""
        focal = np.geomspace(low, high, number)
        first, last = low + _END * (focal[1] - low), high - _END * (high - focal[-2])
        return np.array([low, first, *focal[1:-1], last, high])

    def text(self, nodes: list[Node], job: Export) -> str:
        """All tables at the same nodes."""
        size = np.array(job.lens.image_size)
        rows: dict[str, list[list[float]]] = {name: [] for name in _TABLES}
        for node in nodes:
            camera = pinhole(node, job)
            k1, k2, p1, p2, k3 = camera.coefficients
            rows["DistortionTable"].append([k1, k2, k3, p1, p2])
            rows["FocalLengthTable"].append((camera.f / size).tolist())
            rows["ImageCenterTable"].append(((camera.centre + 0.5) / size).tolist())
            rows["NodalOffsetTable"].append([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        width, height = (size * job.pitch).tolist()
        table = {
            "metadata": {
                "type": "LensFile",
                "version": "0.0.0",
                "lensInfo": {"serialNumber": "", "modelName": "zoomjax", "distortionModel": "Spherical"},
                "name": "zoomjax",
                "nodalOffsetCoordinateSystem": "OpenCV",
                "fxFyUnits": "Normalized",
                "cxCyUnits": "Normalized",
                "userMetadata": [],
            },
            "sensorDimensions": {"width": width, "height": height, "units": "Millimeters"},
            "imageDimensions": {"width": int(size[0]), "height": int(size[1])},
            "cameraParameterTables": [
                {"parameterName": name, "header": header, "data": _data(nodes, rows[name])}
                for name, header in _TABLES.items()
            ],
            "encoderTables": [],
        }
        return json.dumps(table, indent=1) + "\n"

    def recognises(self, head: str) -> bool:
        """By its type."""
        return '"LensFile"' in head

    def read(self, job: Import) -> Contents:
        """The tables, at one focus."""
        table = load_json(read_text(job.paths[0]))
        about = table["metadata"]
        refuse_others(about["lensInfo"], {"distortionModel": "Spherical"})
        refuse_others(about, {"fxFyUnits": "Normalized", "cxCyUnits": "Normalized"})
        size = job.size((table["imageDimensions"]["width"], table["imageDimensions"]["height"]))
        tables = {entry["parameterName"]: _rows(entry) for entry in table["cameraParameterTables"]}
        if len({row["FocusEncoder"] for row in tables["DistortionTable"]}) > 1:
            raise ValueError("it has entries at more than one focus, and zoomjax reads files of one")
        at = {row["ZoomEncoder"] for row in tables["DistortionTable"]}
        rows = {zoom: _numbers(tables, zoom) for zoom in at}
        zooms = np.array(sorted(rows))
        numbers = np.array([rows[zoom] for zoom in zooms])
        width, notes = _width_mm(table.get("sensorDimensions", {}), size)
        mm = width is not None and job.focal is None

        def node(row: np.ndarray) -> Node:
            f, stretch = focal_px(row[0] * size[0], row[1] * size[1])
            focal = float(row[0] * width) if mm and width is not None else f
            return node_of(Pinhole(focal, f, row[2:4] * size - 0.5, row[4:7], row[7:], stretch), size)

        def between(i: int, share: float) -> Node:
            at = (1 - share) * zooms[i] + share * zooms[i + 1]
            return node(self.interpolate(zooms, numbers, float(at)))

        found = contents([node(row) for row in numbers], size, job, mm=mm)
        if mm and width is not None:
            pitch = None if notes else width / size[0]
            found = dataclasses.replace(found, pixel_pitch=pitch, notes=(*found.notes, *notes))
        elif width is not None and found.pixel_pitch is not None:
            other = found.pixel_pitch * size[0]
            told = f"By argument focal its sensor is {other:.4g} mm wide, and the file says {width:.4g} mm."
            off = abs(other / width - 1) > ROUNDED
            found = dataclasses.replace(found, notes=(*found.notes, *[told] * off))
        return found if job.focal is not None else dataclasses.replace(found, between=between)


def _numbers(tables: dict[str, list[dict[str, float]]], zoom: float) -> list[float]:
    """Fx, Fy, Cx, Cy, K1 to K3, P1 and P2 at a zoom."""
    names = ("FocalLengthTable", "ImageCenterTable", "DistortionTable")
    focal, middle, row = (_at(name, tables[name], zoom) for name in names)
    own = [row[name] for name in ("K1", "K2", "K3", "P1", "P2")]
    return [focal["Fx"], focal["Fy"], middle["Cx"], middle["Cy"], *own]


def _width_mm(sensor: dict, size: tuple[int, int]) -> tuple[float | None, tuple[str, ...]]:
    """The width of the sensor, None if it is not there in mm; and that its height contradicts it."""
    width, height = (float(sensor.get(side, 0)) for side in ("width", "height"))
    if sensor.get("units") != "Millimeters" or not width > 0:
        return None, ()
    if not height > 0 or abs(height * size[0] / (width * size[1]) - 1) < _SQUARE:
        return width, ()
    return width, (
        f"Its sensor of {width:g} x {height:g} mm has another shape than images of {size[0]} x {size[1]} "
        "px: focal lengths in mm go by the width, and the size of a pixel is left open.",
    )


def _data(nodes: list[Node], rows: list[list[float]]) -> str:
    return "; ".join(
        ", ".join(map(repr, [0, node.focal, *row])) for node, row in zip(nodes, rows, strict=True)
    )


def _rows(entry: dict) -> list[dict[str, float]]:
    names = [name.strip() for name in entry["header"].split(",")]
    return [
        dict(zip(names, map(float, row.split(",")), strict=True))
        for row in entry["data"].split(";")
        if row.strip()
    ]


def _at(name: str, rows: list[dict[str, float]], zoom: float) -> dict[str, float]:
    """The entry at a zoom, of which the table must have one."""
    encoders = ("FocusEncoder", "ZoomEncoder")
    found = [row for row in rows if np.isclose(row["ZoomEncoder"], zoom, rtol=1e-9)]
    if not found:
        raise ValueError(f"its tables are not at the same zooms: one has no entry at {zoom:g}")
    if len({tuple(value for key, value in row.items() if key not in encoders) for row in found}) > 1:
        raise ValueError(
            f"its {name} has several entries at the zoom {zoom:g}, as at more than one focus, and zoomjax "
            "reads files of one"
        )
    return found[0]
