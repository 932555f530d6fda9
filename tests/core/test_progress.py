"""A bar where somebody looks, and nothing in a log."""

from speckle3d.core.progress import progress_bar


def test_a_bar_tells_what_is_done_of_how_much_in_a_terminal(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # by which rich takes any stream for a terminal
    monkeypatch.setenv("COLUMNS", "100")
    with progress_bar("tracking {0} [b]") as told:
        told(3, 12)
    shown = capsys.readouterr()
    assert "tracking {0} [b]" in shown.err
    assert "3/12" in shown.err
    assert shown.out == ""


def test_a_log_stays_clean(capsys, monkeypatch):
    for variable in ("FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(variable, raising=False)
    with progress_bar("tracking") as told:
        told(3, 12)
    assert capsys.readouterr().err == ""
