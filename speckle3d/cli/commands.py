"""Commands made of functions: an option for each parameter and each field of settings, help from docstrings.

A command is a function with a numpydoc docstring. Options under *Parameters* are common and shown by
``--help`` in that order, those under *Other Parameters* by ``--help-all``. "With --origin or --curve:" and
"Not with --paper." in a help are rules that are checked, as is "One of --level or --labels." in the text. A
parameter annotated with `Fields` of a pydantic model becomes an option for each field, with its description
as help; the function gets the model made of the values that were given.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    NamedTuple,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import typer
from typer.core import TyperCommand, TyperGroup

from speckle3d.cli.common import common_options, emit, note
from speckle3d.cli.outputs import require_own_places
from speckle3d.core.errors import FileError, InvalidInputError

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

Table = Mapping[str, "str | tuple[str, Table]"]
"""Commands by name: where their functions are (``module:function``), or a group's help and its own table."""
Command = Callable[..., Any]

_SETTINGS = {"help_option_names": ["-h", "--help"]}
_SECTION = re.compile(r"^(Parameters|Other Parameters|Examples)\n-+\n", re.MULTILINE)
_ENTRY = re.compile(r"^(\S.*)\n?((?:[ \t]+.*\n?|\n)*)", re.MULTILINE)
_RULE = re.compile(r"\b(With|Not with) (--[\w-]+(?: or --[\w-]+)*)[:.]")
_CHOICE = re.compile(r"\bOne of ((?:[A-Z]+|--[\w-]+) or --[\w-]+)")
_OUTPUT = re.compile(r"(?:-o|--output=)(.+)|-o|--output", re.DOTALL)
_ANY_VIEWER = "frames are cut here, and volumes by any viewer, as 3D Slicer"
_AS_PLUS = "names are PLUS's: Image_Reference, ProbeToReference, ProbeToWorld"
_REPLACEMENTS = {
    ("reconstruct", "--volume-mode"): "`speckle3d volume --mode` writes a volume at any mode's poses",
    ("reconstruct", "--consistent-subset"): "`--drift consistent-subset`, or the setting of that name",
    ("reslice", "--volume"): _ANY_VIEWER,
    ("reslice", "--state"): _ANY_VIEWER,
    ("reslice", "--origin"): "--points takes the origin, a point along the rows and one of the plane",
    ("reslice", "--outlines"): "`view` and the report of `compare` draw where frames are",
    ("reslice", "--reach-mm"): "frames count within twice the sweep's longest steps",
    ("reslice", "--straight"): "--curve takes a spline, which is straight through points on a line",
    ("reslice", "--down"): "--curve runs into the depth, --points takes any plane",
    ("images", "--clock"): "`calibrate clock --by images` finds the offset, --time-offset-s takes it",
    ("images", "--scales"): "calipers tell pixel sizes better; --pixel-mm takes them",
    ("reconstruct", "inertial"): "`fused` takes any sensor there is, `crossed` a second sweep",
    ("reslice", "--difference-to"): "the truth or the tracker if known, else the first --mode",
    ("export", "--frame"): "`convert` and `scene` write poses as 3D Slicer reads them",
    ("accuracy", "--aligned"): "--no-fit-mounting says it",
    ("export", "--length-unit"): "lengths are in metres, as TUM text has them",
    ("score", "--length-unit"): "TUM text is in metres unless its heading names x_mm",
    ("record", "inf"): "without --duration-s it records until Ctrl-C",
    ("live", "--compression"): "`convert --compression gzip` compresses its recording",
    ("play", "--address"): "`ssh -L PORT:localhost:PORT MACHINE` brings it to another machine",
    ("play", "--image"): _AS_PLUS,
    ("play", "--transform"): _AS_PLUS,
    ("play", "--orientation"): _AS_PLUS,
    ("play", "--loop"): "`while speckle3d play SWEEP; do :; done` begins again in a shell",
    ("simulate", "--reverse"): "--preset reversal comes back",
}
"""Words of commands that older versions took, and what replaces them."""


class Fields(NamedTuple):
    """Fields of a pydantic model as options: all, only some, or all but some."""

    model: str
    only: Sequence[str] = ()
    without: Sequence[str] = ()

    def options(self, words: Words) -> dict[str, inspect.Parameter]:
        """Options by the fields' names; the model is loaded."""
        model = _load(self.model)
        kinds, fields = get_type_hints(model), model.model_fields
        names = [name for name in self.only or fields if name not in self.without]
        return {name: _field_option(name, kinds[name], fields[name], words) for name in names}


def _load(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


class Words(NamedTuple):
    """Help of a command from its docstring: text, common options, options' help, examples."""

    text: str
    common: Sequence[str]
    options: Mapping[str, str]
    examples: Sequence[str]

    @classmethod
    def of(cls, function: Command) -> Words:
        """Parse the docstring."""
        text, *parts = _SECTION.split(inspect.getdoc(function) or "")
        sections = dict(zip(parts[::2], parts[1::2], strict=True))
        common, rare = (
            {n: " ".join(body.split()) for names, body in _ENTRY.findall(part) for n in names.split(", ")}
            for part in (sections.get("Parameters", ""), sections.get("Other Parameters", ""))
        )
        examples = re.findall(r"^\$ (.*)", sections.get("Examples", ""), re.MULTILINE)
        return cls(text.strip(), tuple(common), common | rare, examples)


def command_of(name: str, function: Command) -> TyperCommand:
    """Make the command of a function."""
    words, hints = Words.of(function), get_type_hints(function, include_extras=True)
    options: dict[str, inspect.Parameter] = {}
    groups: dict[str, tuple[str, list[str]]] = {}
    places: dict[str, str] = {}
    targets: list[str] = []
    for parameter in inspect.signature(function).parameters.values():
        kind, info = hints[parameter.name], None
        if get_origin(kind) is Annotated:
            kind, (info, *writes) = kind.__origin__, kind.__metadata__
            info = copy(info)
            if writes:
                places[parameter.name] = writes[0]
            if getattr(info, "writable", False):
                targets.append(parameter.name)
        if isinstance(info, Fields):
            members = {name: option for name, option in info.options(words).items() if name not in hints}
            groups[parameter.name] = info.model, list(members)
            options |= members
        else:
            options[parameter.name] = _option(parameter.name, kind, parameter.default, info, words)
    prints = hints["return"] is not type(None)
    if prints:
        options["as_json"] = _option("as_json", bool, False, typer.Option("--json"), words)
    order = [*words.options, *options]
    options = {key: options[key] for key in sorted(options, key=order.index)}

    def run(**values: Any) -> None:
        # Zero is a value of its own, and equal to False.
        flags = {
            _flag_of(option): option
            for name, option in options.items()
            if values[name] is not None and values[name] is not False and values[name] != option.default
        }
        for flag, option in flags.items():
            values[option.name] = _check(flag, option, values[option.name], flags)
        outputs = [(values[name], kind) for name, kind in places.items() if values[name] is not None]
        require_own_places(outputs, [values[name] for name in values.keys() - places], values.get("out"))
        for choice in _CHOICE.finditer(words.text):
            if sum(flag in flags for flag in choice[1].split(" or ")) != 1:
                raise InvalidInputError(f"expected one of {choice[1]}, got both or neither")
        for group, (model, names) in groups.items():
            members = {name: values.pop(name) for name in names}
            values[group] = _make(_load(model), {k: v for k, v in members.items() if v is not None})
        as_json = prints and values.pop("as_json")
        old = {path: _stamps(path) for name in targets if (path := values[name]) and not values.get("append")}
        try:
            numbers, text = function(**values) or (None, "")
        except InvalidInputError as error:  # of a parameter: the option is named as it was typed
            name, _, reason = str(error).partition(": ")
            if name not in options or name in {Path(str(value)).stem for value in values.values()}:
                raise  # of a file of that name
            raise InvalidInputError(f"{_flag_of(options[name])}: {reason}") from error
        if as_json:
            from speckle3d.study.results import json_text

            text = json_text(numbers)
        if text:
            emit(text)
        for path, stamps in old.items():
            if {*stamps.items()} - {*_stamps(path).items()}:
                note(f"replaced what was in {path}")

    run.__signature__ = inspect.Signature(list(options.values()))  # type: ignore[attr-defined]
    run.__annotations__ = {option.name: option.annotation for option in options.values()}
    builder = typer.Typer(add_completion=False, rich_markup_mode=None)
    builder.command(name, cls=PlainCommand, help=words.text, context_settings=_SETTINGS)(run)
    command = typer.main.get_command(builder)
    assert isinstance(command, PlainCommand)
    command.words = words
    return command


_COMMON = Words.of(common_options).options


def _stamps(path: Path) -> dict[Path, int]:
    """When a file, or those in a folder, were written; without empty ones."""
    files = [*path.iterdir()] if path.is_dir() else [path]
    return {file: file.stat().st_mtime_ns for file in files if file.is_file() and file.stat().st_size}


def _make(model: Any, values: Mapping[str, Any]) -> Any:
    """Make settings of options; an error names the first option whose value is refused."""
    from pydantic import ValidationError

    try:
        return model(**values)
    except ValidationError as error:
        from speckle3d.io.toml import first_fault

        name, fault = first_fault(error)
        raise InvalidInputError(f"{_flag(name.partition('.')[0])}: {fault}") from None


def _flag(name: str) -> str:
    return f"--{name.removesuffix('_file').removeprefix('tracker_').replace('_', '-')}"


def _flag_of(option: inspect.Parameter) -> str:
    """Name of an option, or of an argument, in a help."""
    (info,) = option.annotation.__metadata__
    if not isinstance(info, typer.models.OptionInfo):
        return option.name.upper()
    names = [name for name in info.param_decls or () if name.startswith("--")]
    return names[0].partition("/")[0] if names else _flag(option.name)


def _check(flag: str, option: inspect.Parameter, value: Any, flags: Mapping[str, Any]) -> Any:
    """Check the value of an option and return it; a results folder stands for its reconstruction.

    Refused are an option against the rule of its help, a number that is none, an input that is not there.
    """
    (info,) = option.annotation.__metadata__
    for rule in _RULE.finditer(info.help or ""):
        partners = [partner for partner in rule[2].split(" or ") if partner in flags]
        if rule[1] == "With" and not partners:
            raise InvalidInputError(f"{flag}: expected {rule[2]} with it, got none")
        if rule[1] == "Not with" and partners:
            raise InvalidInputError(f"{flag}: expected no {partners[0]} beside it, got both")
    for item in value if isinstance(value, list | tuple) else [value]:
        is_allowed = item == math.inf and re.search(r"\binf\b", info.help or "")
        if isinstance(item, float) and not math.isfinite(item) and not is_allowed:
            raise InvalidInputError(f"{flag}: expected a finite number, got {item}")
        if isinstance(item, Path) and not item.exists() and not info.writable:
            where = f"{flag}: " if isinstance(info, typer.models.OptionInfo) else ""
            raise FileError(f"{where}{item}: expected a file, got none")
    if isinstance(value, Path) and not info.writable and (value / "reconstruction.h5").is_file():
        return value / "reconstruction.h5"
    return value


def _option(name: str, kind: Any, default: Any, info: Any, words: Words) -> inspect.Parameter:
    """A parameter as typer takes it: an argument without a default, unless its annotation says otherwise."""
    flag, only = _flag(name), inspect.Parameter.KEYWORD_ONLY
    info = info or (typer.Argument() if default is inspect.Parameter.empty else typer.Option())
    info.help = words.options.get(name) or info.help or _COMMON.get(name)
    if isinstance(info, typer.models.ArgumentInfo):
        info.metavar = info.metavar or flag.strip("-").upper()
    else:
        for member in get_args(kind):
            if get_origin(member) in (list, tuple):
                info.metavar = " ".join(f"<{item.__name__.lower()}>" for item in get_args(member))
        if info.default is ... and not info.param_decls:
            info.param_decls = (f"{flag}/--no-{flag[2:]}" if default is True else flag,)
    return inspect.Parameter(name, only, default=default, annotation=Annotated[kind, info])


def _field_option(name: str, kind: Any, field: FieldInfo, words: Words) -> inspect.Parameter:
    """An option of a field: of its type if that is a single one, else text that the model reads."""
    if get_origin(kind) in (Union, UnionType) and len(get_args(kind)) > 2:
        kind = str
    default = "" if isinstance(field.default, bool) or field.default in (None, "") else f" ({field.default})"
    text = (field.description or "").removesuffix(".")
    info = typer.Option(help=text and f"{text[:1].upper()}{text[1:]}{default}.")
    return _option(name, kind | None, None, info, words)


class PlainCommand(TyperCommand):
    """A command whose help is plain text: common options, the others on request, and examples."""

    words: Words

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take `-o FILE` where the output is an argument, as everywhere else; answer for removed words."""
        for word in args:
            if text := _REPLACEMENTS.get((str(self.name), word.partition("=")[0])):
                raise InvalidInputError(f"{word} was removed: {text}")
        shows_all = "--help-all" in args
        for param in self.params:
            param.hidden = not shows_all and param.name not in self.words.common  # type: ignore[attr-defined]
        args = ["--help"] if shows_all else args
        if any(param.name == "out" and param.param_type_name == "argument" for param in self.params):
            args = _output_last(args)
        return list(super().parse_args(ctx, args))

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Print examples, and how many options are not shown."""
        formatter.write("".join(["\nExample:\n", *(f"  {line}\n" for line in self.words.examples)]))
        if count := sum(param.hidden for param in self.params):  # type: ignore[attr-defined]
            formatter.write(f"\nOther options ({count}): {ctx.command_path} --help-all\n")


def _output_last(args: list[str]) -> list[str]:
    for i, word in enumerate(args):
        if match := _OUTPUT.fullmatch(word):
            value, after = ([match[1]], i + 1) if match[1] else (args[i + 1 : i + 2], i + 2)
            return [*args[:i], *args[after:], *value]
    return args


class Group(TyperGroup):
    """A group of commands, each loaded when it is asked for, whose help is plain text."""

    table: Table

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command or group of that name; None if there is none."""
        if cmd_name in self.table and self.commands[cmd_name] is None:
            entry = self.table[cmd_name]
            made = group(*entry) if isinstance(entry, tuple) else command_of(cmd_name, _load(entry))
            self.commands[cmd_name] = made
        return super().get_command(ctx, cmd_name)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print usage, what the group is for, and its commands, each with its first sentence."""
        self.format_usage(ctx, formatter)
        self.format_help_text(ctx, formatter)
        rows = []
        for name, entry in self.table.items():
            text = entry[0] if isinstance(entry, tuple) else inspect.getdoc(_load(entry)) or ""
            sentence = re.split(r"[.;](?:\s|$)", text, maxsplit=1)[0]
            rows.append((name, " ".join(sentence.split()) + "."))
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def group(text: str, table: Table) -> Any:
    """Make a group of commands."""
    builder = typer.Typer(cls=Group, add_completion=False, no_args_is_help=True, context_settings=_SETTINGS)
    builder.callback(help=text)(lambda: None)
    command: Any = typer.main.get_command(builder)
    command.table, command.commands = table, dict.fromkeys(table)
    return command
