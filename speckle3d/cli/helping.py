"""How help is shown: never cut, at any width; common options first, the others under "Advanced"."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from speckle3d.cli.before import require_before_work

ADVANCED = "Advanced"

COMMON: dict[str, Sequence[str]] = {
    "compare": ("out", "drift", "reference", "curves_file", "workers", "paper", "as_json"),
    "convert": (
        "out",
        "calibration",
        "mode",
        "sampling_rate_hz",
        "vector_pitch_mm",
        "bandwidth_hz",
        "plus_config",
    ),
    "live": ("out", "curves_file", "calibration", "transform", "orientation", "drift", "check", "volume"),
    "reconstruct": (
        "out",
        "curves_file",
        "drift",
        "crossing_file",
        "calibration",
        "volume",
        "reference",
        "as_json",
    ),
    "reslice": ("out", "mode", "lateral_mm", "depth_mm", "frame", "points", "curve", "on"),
    "scene": ("out", "mode", "images", "voxel_mm", "calibration"),
    "surface": ("out", "level", "below", "labels", "smooth", "largest", "as_json"),
    "view": ("calibrate", "phantom", "sensor", "record", "poses", "port"),
    "volume": (
        "out",
        "mode",
        "voxel_mm",
        "rule",
        "fill_radius",
        "dynamic_range_db",
        "calibration",
        "as_json",
    ),
    "clock": ("out", "by", "calibration", "poses", "transform", "search_s", "as_json"),
    "images": ("out", "start", "start_mm", "start_deg", "poses", "transform", "clock", "as_json"),
    "plane": ("out", "reflector", "poses", "transform", "pixel_mm", "time_offset_s", "validation", "as_json"),
    "orientation": (
        "out",
        "sensor",
        "level",
        "viewed_from",
        "poses",
        "time_offset_s",
        "validation",
        "as_json",
    ),
    "wires": ("out", "phantom", "points", "poses", "transform", "pixel_mm", "time_offset_s", "as_json"),
    "orient": ("into", "out", "method", "magnetometer", "time_offset_s", "calibration"),
    "accuracy": ("reference", "optical", "calibrations", "method", "figure", "as_json"),
}
"""Options that most runs of a command want; its others are shown under "Advanced"."""


class Command(TyperCommand):
    """A command whose help is plain text, in panels."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print usage, what it does, arguments, and options by panel."""
        self.format_usage(ctx, formatter)
        self.format_help_text(ctx, formatter)
        self.format_options(ctx, formatter)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take `-o FILE` where the output is an argument, as it is everywhere else."""
        if any(each.name == "out" and each.param_type_name == "argument" for each in self.params):
            args = _output_last(args)
        return list(super().parse_args(ctx, args))

    def invoke(self, ctx: Any) -> Any:
        """Run the command, once its files and choices can be right."""
        options = {each.name: max(each.opts, key=len) for each in self.params if each.opts[0][:1] == "-"}
        require_before_work(self.name or "", ctx.params, options)
        return super().invoke(ctx)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Print the options of each panel, in the order in which the panels begin."""
        panels: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            record = param.get_help_record(ctx)
            if record is not None:
                panels.setdefault(self.panel_of(param), []).append(record)
        for panel in sorted(panels, key=lambda name: (name != "Arguments", name == ADVANCED)):
            with formatter.section(panel):
                formatter.write_dl(panels[panel])

    def panel_of(self, param: Any) -> str:
        """Heading that an option is shown under."""
        if param.param_type_name == "argument":
            return "Arguments"
        given = getattr(param, "rich_help_panel", None)
        common = COMMON.get(self.name or "")
        if common is None or param.name in (*common, "help"):
            return given or "Options"
        return given or ADVANCED


class Group(TyperGroup):
    """A group of commands whose help is plain text, each with its first sentence whole."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print usage, what the group is for, its options and its commands."""
        self.format_usage(ctx, formatter)
        self.format_help_text(ctx, formatter)
        records = [param.get_help_record(ctx) for param in self.get_params(ctx)]
        with formatter.section("Options"):
            formatter.write_dl([record for record in records if record is not None])
        with formatter.section("Commands"):
            formatter.write_dl([(name, _first_sentence(each.help)) for name, each in self.commands.items()])


class App(typer.Typer):
    """A typer application whose commands and groups show help in this way."""

    def __init__(self, **options: Any) -> None:
        settings = {"help_option_names": ["-h", "--help"]}
        super().__init__(**{"cls": Group, "context_settings": settings, "no_args_is_help": True, **options})

    def command(self, name: str | None = None, **options: Any) -> Callable[[Any], Any]:
        """Register a command; see `typer.Typer.command`."""
        return super().command(name, **{"cls": Command, **options})


def _output_last(args: list[str]) -> list[str]:
    for i, each in enumerate(args[:-1]):
        if each in ("-o", "--output"):
            return [*args[:i], *args[i + 2 :], args[i + 1]]
    return args


def _first_sentence(text: str | None) -> str:
    paragraph = " ".join((text or "").split("\n\n")[0].split())
    return paragraph.split("; ")[0].split(". ")[0].rstrip(".") + "."
