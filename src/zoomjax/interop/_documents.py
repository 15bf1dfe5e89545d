"""JSON and YAML of other tools, no name given twice in them: readers differ in which of two they take."""

import json
import re
from pathlib import Path
from typing import Any

from ..models.registry import once
from .base import read_text


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
