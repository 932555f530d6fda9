import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from speckle3d.app.folder import Folder
from speckle3d.app.sweep import player as module
from speckle3d.app.sweep.page import SweepPage
from speckle3d.app.sweep.player import Player
from speckle3d.core.doubts import Doubt

# Panel 1.9 already has other words for arguments that 1.5 needs.
pytestmark = pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")


@pytest.fixture(scope="module")
def seen(sweep, shipped):
    """The player of a page; nothing calls its clock."""
    made = []
    start = Player.__init__
    doubts = [Doubt("tracker", "spikes", "some <b>jump</b>", False, ((40, 46),))]
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        # The marks of the tests do not hold for what they share.
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        patch.setattr(Player, "__init__", lambda self, *given: (made.append(self), start(self, *given))[1])
        SweepPage(sweep, Folder(shipped / "phantom.h5"), doubts=doubts).view()
    (player,) = made
    assert player._findings.flags is None
    assert "no flag" not in player._told.object
    while player._findings.flags is None:
        player._tick()
    assert "no flag" in player._told.object
    return player


@pytest.fixture
def player(seen):
    """The same as if it had just been opened."""
    seen._play.value, seen._colouring.value, seen._range.value = False, "none", 60
    seen._lag, seen._keys_heard, seen._keys.pressed = -1, 0, []
    drawn(seen)
    seen.go(0)
    for _ in range(3):
        drawn(seen)
    return seen


def drawn(player):
    """The browser says that it has drawn what it was sent."""
    player._picture.drawn.data = {"count": [player._count]}


def press(player, *keys):
    for key in keys:
        player._keys.pressed = [*player._keys.pressed, [player._keys_heard + 1, key]]
        drawn(player)


@pytest.mark.parametrize(
    ("keys", "frame"),
    [
        (["ArrowRight", "ArrowRight"], 2),
        (["ArrowRight", "ArrowLeft", "ArrowLeft"], 0),
        (["Shift+ArrowRight", "PageDown", "ArrowLeft"], 19),
        (["End"], 95),
        (["End", "ArrowRight", "PageUp", "Home"], 0),
    ],
)
def test_keys_move_the_frame_the_slider_the_cursor_and_the_words(player, sweep, keys, frame):
    press(player, *keys)
    assert player.frame == frame
    assert player._slider.value == frame
    assert player._line.cursor.location == sweep.frame_time_s[frame]
    assert f"Frame {frame}</b> of 0 to 95" in player._told.object


def test_keys_that_come_together_all_count_and_each_once(player):
    player._keys.pressed = [[1, "ArrowRight"], [2, "PageDown"], [3, "ArrowRight"]]
    assert player.frame == 12
    player._keys.pressed = [[2, "PageDown"], [3, "ArrowRight"], [4, "ArrowLeft"]]
    assert player.frame == 11
    # A page that was left and is seen again counts anew.
    player._keys.pressed = [[1, "ArrowLeft"]]
    assert player.frame == 10


def test_what_is_sent_is_the_frames_image(player):
    player._slider.value = 33
    np.testing.assert_array_equal(player._picture.image.data["image"][0], player._images.image(33))
    player._range.value = 40
    np.testing.assert_array_equal(player._picture.image.data["image"][0], player._images.image(33, 40))


def test_a_slow_browser_is_sent_the_latest_frame_only(player, monkeypatch):
    sent = []
    show = player._picture.show
    monkeypatch.setattr(player._picture, "show", lambda *given: (sent.append(given[1]), show(*given))[1])
    for frame in range(10, 30):
        player.go(frame)
    assert len(sent) == 1
    assert player._slider.value == 10
    drawn(player)
    assert len(sent) == 2
    assert player._slider.value == 29


def test_a_browser_that_never_answers_is_not_waited_for_for_ever(player, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    player.go(5)
    player.go(6)
    assert player._shown == 5
    now[0] += 1.1
    player._tick()
    assert player._shown == 6


def test_space_plays_at_the_recordings_own_rate_and_ends_at_the_end(player, sweep, monkeypatch):
    now = [50.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    press(player, "Shift+ArrowRight", " ")
    assert player._play.value
    now[0] += 1.5
    player._tick()
    drawn(player)
    expected = np.searchsorted(sweep.frame_time_s, sweep.frame_time_s[10] + 1.5, side="right") - 1
    assert player.frame == expected == 47
    now[0] += 100.0
    player._tick()
    assert player.frame == 95
    assert not player._play.value
    drawn(player)
    press(player, " ")
    assert player._play.value
    assert player.frame == 0


def test_while_it_plays_a_key_moves_on_from_there(player, monkeypatch):
    now = [50.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    press(player, " ", "Shift+ArrowRight")
    now[0] += 0.05
    player._tick()
    assert player.frame in (10, 11)


def test_choosing_another_frame_to_compare_with_stays_as_far_off_on_the_next(player):
    player._colouring.value = "correlation"
    press(player, "Shift+ArrowRight")
    assert player._other.value == 9
    player._other.value = 7
    press(player, "ArrowRight")
    assert player._other.value == 8
    assert "With frame 8" in player._told.object
    player._colouring.value = "none"
    assert "With frame" not in player._told.object
    assert len(player._picture._patches.data["x"]) == 0


def test_doubts_are_marked_at_their_frames_and_said_without_their_markup(player, sweep):
    marks = player._line._marks.data
    half = np.median(np.diff(sweep.frame_time_s)) / 2
    assert marks["left"] == pytest.approx([sweep.frame_time_s[40] - half])
    assert marks["right"] == pytest.approx([sweep.frame_time_s[46] + half])
    assert player._line._rows.factors == ["tracker"]
    assert "some &lt;b&gt;jump&lt;/b&gt;" in str([each.object for each in player._doubts().objects[1:2]])


def test_frames_were_judged_while_nothing_played(player):
    assert "no flag" in player._told.object
    assert "None of 96 frames flagged" in player._judged.object


def test_a_sweep_of_one_frame_has_a_page(sweep, shipped):
    SweepPage(sweep.part(0, 1), Folder(shipped / "phantom.h5")).view()
