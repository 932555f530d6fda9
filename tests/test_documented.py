"""Public functions explain every parameter and what comes back; public classes what they hold."""

import inspect
import re
from dataclasses import fields, is_dataclass

import pytest
from pydantic import BaseModel

import speckle3d
import xsens

PUBLIC = [
    pytest.param(getattr(package, name), id=f"{package.__name__}.{name}")
    for package in (speckle3d, xsens)
    for name in dir(package)
    if not name.startswith("_") and callable(getattr(package, name))
]


def section(doc, *titles):
    """Lines of sections of a numpydoc docstring."""
    lines = []
    for title in titles:
        match = re.search(rf"^{title}\n-+\n(.*?)(?=^\w[^\n]*\n-+\n|\Z)", doc, re.MULTILINE | re.DOTALL)
        lines += match[1].splitlines() if match else []
    return lines


def entry_names(doc, *titles):
    """Names that stand at the beginning of a section's entries, several to an entry by commas."""
    entries = [line.split(" : ")[0] for line in section(doc, *titles) if line and not line.startswith(" ")]
    return {name.strip().lstrip("*") for entry in entries for name in entry.split(",")}


@pytest.mark.parametrize("thing", PUBLIC)
def test_it_says_what_it_takes_and_gives(thing):
    doc = inspect.getdoc(thing) or ""
    assert doc.strip()
    if inspect.isfunction(thing):
        parameters = inspect.signature(thing).parameters
        missing = set(parameters) - entry_names(doc, "Parameters", "Other Parameters")
        assert not missing
        gives = inspect.signature(thing).return_annotation
        if gives not in (None, "None"):
            assert section(doc, "Returns", "Yields") or doc.split()[0] in ("Whether",), "Returns"
    elif is_dataclass(thing) and not issubclass(thing, BaseModel):
        public = {field.name for field in fields(thing) if not field.name.startswith("_")}
        assert not public - entry_names(doc, "Parameters", "Attributes")
