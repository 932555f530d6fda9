"""A bar where somebody looks, and nothing in a log."""

from speckle3d.core.progress import progress_bar


def test_a_log_stays_clean(capsys, monkeypatch):
    for variable in ("FORCE_COLOR", "TTY_COMPATIBLE"):
        monkeypatch.delenv(variable, raising=False)
    with progress_bar("tracking") as told:
        told(3, 12)
    assert capsys.readouterr().err == ""
