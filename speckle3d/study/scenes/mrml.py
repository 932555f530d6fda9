"""Scenes of 3D Slicer (.mrml): nodes that refer to each other, and to files beside the scene.

A node that has a file refers to a storage node, which names the file relative to the scene's folder, as part
of a URL [1]_. Nodes are read in order; those that others refer to come first.

References
----------
.. [1] 3D Slicer, sources of vtkMRMLScene, vtkMRMLNode and the node classes named here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import jinja2

from speckle3d.core.labels import Segment
from speckle3d.core.printable import printable

_TEMPLATE = Path(__file__).with_name("scene.mrml")
_CLASSES = {"Volume": "ScalarVolume", "VolumeDisplay": "ScalarVolumeDisplay"}
"""Of nodes whose class is named otherwise than their tag."""
_VIEWS = ("Red", "Green", "Yellow")
GREY, COLOURED = "vtkMRMLColorTableNodeGrey", "vtkMRMLColorTableNodeFileViridis.txt"
"""Colour tables that Slicer has."""


@dataclass(frozen=True)
class Node:
    """One element of a scene.

    Attributes
    ----------
    tag : str
        As Volume; its class is vtkMRMLScalarVolumeNode.
    attributes : dict
        With its ``id``, and ``references`` by role.
    """

    tag: str
    attributes: dict[str, str]


class Scene:
    """A scene to which nodes are added; every method returns the identity of the node added last."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._counts: Counter[str] = Counter()

    def text(self) -> str:
        """Whole scene as XML; everything that comes from outside is escaped."""
        environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
        return template.render(nodes=self.nodes)

    def add_volume(
        self, name: str, file: str, window: tuple[float, float] | None = None, colours: str = GREY
    ) -> str:
        """Add a volume.

        Parameters
        ----------
        window : tuple of float, optional
            Levels shown as the darkest and the brightest; by default as Slicer finds them.
        """
        shown = {"colorNodeID": colours, "interpolate": "1", "autoWindowLevel": "1"}
        if window is not None:
            low, high = window
            shown["autoWindowLevel"] = "0"
            shown |= {"window": f"{high - low:g}", "level": f"{(low + high) / 2:g}"}
        storage = self._storage("VolumeArchetypeStorage", file, centerImage="0", UseOrientationFromFile="1")
        return self._named(
            "Volume", name, {"display": self._add("VolumeDisplay", **shown), "storage": storage}
        )

    def add_labels(self, name: str, file: str, volume: str, segments: tuple[Segment, ...]) -> str:
        """Add a segmentation of a volume, hidden; its segments are told in its file."""
        display = self._add("SegmentationDisplay", visibility="false", opacity="0.5")
        references = {"display": display, "storage": self._storage("SegmentationStorage", file)}
        said = f"{name}: {', '.join(segment.name for segment in segments)}"
        return self._named("Segmentation", said, references | {"referenceImageGeometryRef": volume})

    def add_lines(self, name: str, file: str, colour: tuple[float, float, float], visible: bool) -> str:
        """Add lines in space, of a file with axes that lead left, posterior and superior."""
        display = self._add(
            "ModelDisplay",
            color=" ".join(f"{part:g}" for part in colour),
            lineWidth="1",
            representation="1",
            lighting="false",
            scalarVisibility="false",
            visibility="true" if visible else "false",
        )
        storage = self._storage("ModelStorage", file, coordinateSystem="LPS")
        return self._named("Model", name, {"display": display, "storage": storage})

    def add_transform(self, name: str, file: str) -> str:
        """Add a linear transform."""
        return self._named("LinearTransform", name, {"storage": self._storage("TransformStorage", file)})

    def add_moving_images(self, name: str, images: str, poses: str, frames_per_s: float) -> str:
        """Add images of one place in a file, and their poses in another, played together in the world.

        Slicer shows the present image and pose by nodes that stand for them: a volume under a transform.
        """
        sequences = [
            self._sequence(f"{name}: images", "VolumeSequenceStorage", images),
            self._sequence(f"{name}: poses", "LinearTransformSequenceStorage", poses),
        ]
        pose = self._named("LinearTransform", f"{name}: present pose", {})
        display = self._add(
            "VolumeDisplay", colorNodeID=GREY, autoWindowLevel="0", window="255", level="127.5"
        )
        image = self._named("Volume", f"{name}: present image", {"display": display, "transform": pose})
        roles = {f"sequenceNodeRef{i}": each for i, each in enumerate(sequences)}
        roles |= {f"dataNodeRef{i}": each for i, each in enumerate((image, pose))}
        synchronised = "playback true recording false overwriteProxyName false saveChanges false"
        return self._named(
            "SequenceBrowser",
            name,
            roles,
            playbackRateFps=f"{frames_per_s:g}",
            selectedItemNumber="0",
            virtualNodePostfixes=" ".join(str(i) for i in range(len(sequences))),
            **{f"SynchronizationPropertiesMap{i}": synchronised for i in range(len(sequences))},
        )

    def show(self, volume: str) -> None:
        """Show a volume in the three slice views."""
        for view in _VIEWS:
            attributes = {
                "id": f"vtkMRMLSliceCompositeNode{view}",
                "singletonTag": view,
                "layoutName": view,
                "backgroundVolumeID": volume,
                "linkedControl": "1",
            }
            self.nodes.append(Node("SliceComposite", attributes))

    def _sequence(self, name: str, storage: str, file: str) -> str:
        references = {"storage": self._storage(storage, file)}
        return self._named("Sequence", name, references, indexName="time", indexUnit="s", indexType="numeric")

    def _storage(self, tag: str, file: str, **attributes: str) -> str:
        return self._add(tag, fileName=quote(file), useCompression="1", **attributes)

    def _named(self, tag: str, name: str, references: Mapping[str, str], **attributes: str) -> str:
        if references:
            attributes["references"] = "".join(f"{role}:{to};" for role, to in references.items())
        return self._add(tag, name=printable(name), **attributes)

    def _add(self, tag: str, **attributes: str) -> str:
        self._counts[tag] += 1
        identity = f"vtkMRML{_CLASSES.get(tag, tag)}Node{self._counts[tag]}"
        self.nodes.append(Node(tag, {"id": identity, **attributes}))
        return identity
