"""Help reads well at 80 columns, options are named alike, and what cannot be is refused before work."""

import pytest
import typer.main

from speckle3d.cli import app


def commands(command=None, name=()):
    command = command or typer.main.get_command(app)
    if hasattr(command, "commands"):
        for key, each in command.commands.items():
            yield from commands(each, (*name, key))
    elif not command.hidden:
        yield name, command


COMMANDS = dict(commands())


@pytest.fixture(params=COMMANDS, ids=" ".join)
def name(request):
    return request.param


def test_help_is_not_cut_at_80_columns(run, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run(*name, "-h")
    assert code == 0
    assert "…" not in out
    assert max(map(len, out.splitlines())) <= 80
    for param in COMMANDS[name].params:
        if param.param_type_name == "option" and not param.hidden:
            assert max(param.opts, key=len) in out


def test_every_parameter_is_explained(name):
    command = COMMANDS[name]
    if hasattr(command, "describe"):
        command.describe()
    for param in command.params:
        if getattr(param, "hidden", False):
            continue
        assert (getattr(param, "help", "") or "").strip(), param.name


def test_a_command_shows_no_more_than_nine_options_first(run, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    _, out, _ = run(*name, "-h")
    first = out.split("Options:\n")[1].split("\n\n")[0] if "Options:\n" in out else ""
    assert len([line for line in first.splitlines() if line.startswith("  -")]) <= 10


def test_the_version_is_told(run):
    code, out, _ = run("--version")
    assert code == 0
    assert out.startswith("speckle3d ")


def test_output_is_an_option_everywhere(run, tmp_path):
    out = tmp_path / "s.h5"
    code, _, err = run("simulate", "--vectors", "8", "--samples", "600", "-o", out, "--frames", "2")
    assert code == 0, err
    code, _, err = run("convert", out, "-o", tmp_path / "t.h5")
    assert code == 0, err
    assert (tmp_path / "t.h5").exists()


def test_every_setting_is_printed_with_what_it_is_and_its_default(run):
    from speckle3d.config import Config, config_from_toml

    code, out, _ = run("config")
    assert code == 0
    assert config_from_toml(out) == Config()
    lines = out.splitlines()
    for i, line in enumerate(lines):
        if " = " in line and not line.startswith("#"):
            assert lines[i - 1].startswith("# "), line
    assert out.count("Default ") >= 70


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("reconstruct", "{sweep}", "-o", "x", "--drift", "nonsense"), "--drift: expected one of"),
        (("reconstruct", "{sweep}", "-o", "x", "--reference", "nonsense"), "--reference: expected one of"),
        (("reconstruct", "none.h5", "-o", "x"), "none.h5: expected a file"),
        (("reconstruct", "{sweep}", "-o", "x", "--curves", "none.h5"), "--curves: none.h5: expected a file"),
        (("reconstruct", "{sweep}", "-o", "{sweep}/x"), "expected an existing folder"),
        (("compare", "{sweep}", "-o", "x", "--drift", "nonsense"), "--drift: expected one of"),
        (("volume", "none.h5", "-o", "v.nrrd"), "none.h5: expected a file"),
        (("calibrate", "plane", "none.h5", "-o", "t.h5"), "none.h5: expected a file"),
        (("calibrate", "plane", "{sweep}", "-o", "{sweep}/t.h5"), "expected an existing folder"),
        (("imu", "orient", "{sweep}", "--into", "none.h5"), "--into: none.h5: expected a file"),
        (("imu", "orient", "{sweep}", "--into", "{sweep}"), "--replace replaces it"),
    ],
)
def test_what_is_refused_is_refused_before_work(refused, monkeypatch, tmp_path, shipped, arguments, expected):
    from speckle3d import pipeline, sensor_logs

    def work(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr(pipeline, "track", work)
    monkeypatch.setattr(sensor_logs, "ridden_along", work)
    monkeypatch.chdir(tmp_path)
    line = refused(*(each.format(sweep=shipped / "phantom.h5") for each in arguments))
    assert expected in line
    assert not list(tmp_path.iterdir())
