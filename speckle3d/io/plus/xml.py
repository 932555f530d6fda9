"""XML documents of PLUS: read, and told by their first element."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from speckle3d.core.errors import InvalidInputError
from speckle3d.core.files import PathLike, open_regular
from speckle3d.io.hdf5 import one_line, reading
from speckle3d.io.text import numbers


def read_xml(path: PathLike) -> Element:
    """Read a document's first element.

    Raises
    ------
    FileError
        If the file cannot be read.
    InvalidInputError
        If it is no XML, or has a type declaration: the entities it may declare can grow without bounds.
    """
    with reading(path), open_regular(path) as stream:
        text = stream.read()
    try:
        return ElementTree.fromstring(text, ElementTree.XMLParser(target=_PlainTree()))
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InvalidInputError(f"{path}: expected well-formed XML, got: {one_line(error)}") from error


def vector(element: Element, attribute: str, count: int) -> tuple[float, ...]:
    """Read an attribute of `count` numbers."""
    label = element.get("Name") or element.get("From") or ""
    where = f"{element.tag}{f' {label}' if label else ''}: {attribute}"
    return numbers(element.get(attribute, ""), count, where)


class _PlainTree(ElementTree.TreeBuilder):
    """The tree of a document without a type declaration, so that it has no entities of its own."""

    def doctype(self, name: str, *_: object) -> None:
        raise ValueError(f"a document type declaration ({name})")
