"""JSON, YAML, XML and lines of other tools.

No name is twice in them: readers differ in which of two they take.
"""

import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

from ..models.registry import once
from .base import read_text


def lines_of(path: Path) -> tuple[list[str], tuple[str, ...]]:
    """The lines of a text whose lines end with numbers; with a note, if the last one may be cut off."""
    text = read_text(path)
    whole = text.endswith("\n") or not text
    note = (
        f"The last line of {path} has no end: if the file was cut off there, its last number is another. "
        "Compare it with the original."
    )
    return text.splitlines(), () if whole else (note,)


def load_json(text: str) -> Any:
    """Values of JSON."""
    return json.loads(text, object_pairs_hook=once)


def load_yaml(path: Path) -> Any:
    """A YAML file of plain values, or of OpenCV's matrices; no code can be in it."""
    import yaml

    class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # pyright: ignore[reportGeneralTypeIssues]
        """Safe, and knows OpenCV's matrices."""

        def construct_mapping(self, node, deep=False):
            """Of different names: readers differ in which of two they take."""
            once([(key.value, None) for key, _ in node.value])
            return super().construct_mapping(node, deep=deep)

    def matrix(loader, node):
        return loader.construct_mapping(node, deep=True)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix)
    text = read_text(path)
    try:
        found = yaml.load(re.sub(r"\A%YAML:1\.0", "%YAML 1.1", text), Loader)
    except yaml.YAMLError as error:
        raise ValueError(f"it is no YAML: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(found, dict):
        raise ValueError("it is no table of names and values")
    return found


def load_opencv(path: Path) -> dict[str, Any]:
    """What ``cv2.FileStorage`` wrote as YAML, XML or JSON; names in lower case.

    Programs that follow OpenCV's first samples write them with capitals.
    """
    text = read_text(path).lstrip()
    if text.startswith("<"):
        found = once([(value.tag, _value_of_xml(value)) for value in ET.fromstring(text)])
    else:
        found = load_json(text) if text.startswith("{") else load_yaml(path)
    return once([(str(name).lower(), value) for name, value in found.items()])


def _value_of_xml(element: ET.Element) -> Any:
    """A word, or a matrix as in OpenCV's YAML."""
    if element.get("type_id") != "opencv-matrix":
        return (element.text or "").strip().strip('"')
    return once(
        [(part.tag, (part.text or "").split() if part.tag == "data" else part.text) for part in element]
    )
