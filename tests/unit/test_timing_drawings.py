"""The drawings in docs/timing.md are what their tool draws, well-formed, and all shown."""

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from tools.timing_drawings import DRAWINGS, main

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.parametrize("name", DRAWINGS)
def test_drawing_is_current(name, tmp_path):
    assert main([str(tmp_path)]) == 0
    text = (tmp_path / f"{name}.svg").read_text(encoding="utf-8")
    assert text == (DOCS / "figures" / f"{name}.svg").read_text(encoding="utf-8")
    root = ET.fromstring(text)
    width, height = (float(v) for v in root.attrib["viewBox"].split()[2:])
    for shape in root.iter():
        x, y = float(shape.attrib.get("x", 0)), float(shape.attrib.get("y", 0))
        assert 0 <= x <= width
        assert 0 <= y <= height
    assert f"figures/{name}.svg" in (DOCS / "timing.md").read_text(encoding="utf-8")
