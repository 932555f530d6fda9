"""Help reads well at 80 columns, options are named alike, and what cannot be is refused before work."""

import shlex

import pytest

from speckle3d.cli import app


def commands(command=app, name=()):
    if not hasattr(command, "commands"):
        yield name, command
        return
    for key in command.table:
        yield from commands(command.get_command(None, key), (*name, key))


COMMANDS = dict(commands())


@pytest.mark.parametrize("name", COMMANDS, ids=" ".join)
def test_a_page_of_help_is_short_whole_and_has_an_example(run, name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run(*name, "-h")
    assert code == 0
    assert len(out.splitlines()) < 40
    assert max(map(len, out.splitlines())) <= 80
    command = COMMANDS[name]
    for line in command.words.examples:
        words = shlex.split(line.split(" > ")[0])
        assert words[: len(name) + 1] == ["speckle3d", *name]
        command.make_context("speckle3d", words[len(name) + 1 :])
    assert f"Example:\n  {command.words.examples[0]}\n" in out
    _, every, _ = run(*name, "--help-all")
    for param in command.params:
        assert param.help.strip(), param.name
        if param.param_type_name == "option":
            assert max(param.opts, key=len) in every
    assert not set(command.words.options) - {param.name for param in command.params}


@pytest.mark.parametrize("words", [("{}",), ("-o{}",), ("--output={}",)])
def test_an_output_is_an_argument_or_an_option_in_every_spelling(run, tmp_path, words):
    out = tmp_path / "s.h5"
    small = ("--vectors", "8", "--samples", "600", "--frames", "2")
    code, _, err = run("simulate", *(word.format(out) for word in words), *small)
    assert code == 0, err
    assert out.exists()


def test_every_setting_is_printed_with_its_default(run):
    from speckle3d.config import Config, config_from_toml

    code, out, _ = run("config")
    assert code == 0
    assert config_from_toml(out) == Config()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("reconstruct", "{sweep}", "-o", "x", "--curves", "none.h5"), "--curves: none.h5: expected a file"),
        (("calibrate", "plane", "{sweep}", "-o", "{sweep}/t.h5"), "expected an existing folder"),
        (
            ("compare", "-o", "x", "--paper", "--curves", "{sweep}", "--drift", "pose"),
            "--paper: expected no --drift",
        ),
        (("imu", "orient", "{sweep}", "--into", "{sweep}"), "--replace replaces it"),
        (("volume", "{sweep}", "-o", "v.nrrd", "--mode", "image"), "make its reconstruction first"),
        (("volume", "{sweep}", "-o", "v.xyz"), "v.xyz: expected a name ending in .nrrd"),
        (("volume", "{sweep}", "-o", "v.nrrd", "--within-gb", "-1"), "--within-gb: expected enough"),
        (("reslice", "{sweep}", "-o", "c.png", "--depth-mm", "500"), "--depth-mm: expected a value inside"),
        (("reslice", "{sweep}", "-o", "c.png", "--pixel-mm", "0"), "--pixel-mm"),
        (
            ("imu", "accuracy", "{sweep}", "--optical", "{sweep}", "--turns", "roll"),
            "expected --reference with",
        ),
        (("calibrate", "clock", "{sweep}", "-o", "t.h5"), "--output: expected --calibration with it"),
        (("compare", "{sweep}", "-o", "{sweep}"), "expected a folder or a new name, got the file"),
        (("reslice", "{sweep}", "-o", "c.png", "--state=s.nrrd"), "--state=s.nrrd was removed: "),
        (("view", "{sweep}", "--pixel-mm", "1", "1"), "--pixel-mm: expected --calibrate"),
        (("calibrate", "plane", "{sweep}", "-o", "t.h5", "--pixel-mm", "0", "1"), "greater than 0, got 0"),
    ],
)
def test_what_is_refused_is_refused_before_work(
    refuse, monkeypatch, tmp_path, data_folder, arguments, expected
):
    from speckle3d import sensor_logs
    from speckle3d.study import job, paper

    def work(*_, **__):
        raise AssertionError("the work began")

    monkeypatch.setattr(job, "track", work)
    monkeypatch.setattr(paper, "paper_study", work)
    monkeypatch.setattr(sensor_logs, "ridden_along", work)
    monkeypatch.chdir(tmp_path)
    sweep = data_folder / "phantom.h5"
    assert expected.format(sweep=sweep) in refuse(*(word.format(sweep=sweep) for word in arguments))
    assert not list(tmp_path.iterdir())
