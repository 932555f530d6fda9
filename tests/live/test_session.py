"""Messages in, a recording, poses and words out; without a network."""

import time

import numpy as np
import pytest
from igtl_examples import decode_whole
from scipy.spatial.transform import RigidTransform

import speckle3d as s3
from speckle3d.io.igtl.messages import ImageReceived, TransformReceived
from speckle3d.io.import_settings import ImportSettings, MissingSettingsError
from speckle3d.live.frames import POSE, ImageLayout
from speckle3d.live.session import ADVICE, VOLUME, Session, SessionSettings

RF = ImportSettings(
    sampling_rate_hz=2e8 / 3,
    vector_pitch_mm=0.3,
    speed_of_sound_m_s=1540.0,
    centre_frequency_hz=7.5e6,
    bandwidth_hz=(5e6, 10e6),
)


def image(frame, time_s):
    """RF as PLUS sends it: samples along the columns."""
    return ImageReceived("Image_Reference", time_s, frame.T, np.eye(4))


def reading(time_s, device="ProbeToReference"):
    return TransformReceived(device, time_s, np.eye(4), True)


class Messages:
    """Some messages at a time, then silence until the session's progress meets a condition."""

    def __init__(self, batches, until):
        self.batches, self.until, self.session = list(batches), until, None
        self.until_s = time.monotonic() + 300

    def receive(self, timeout_s):
        if self.batches and len(self.session._queue) < 3:
            return self.batches.pop(0)
        time.sleep(0.005)
        if self.until(self.session.progress) or time.monotonic() > self.until_s:
            self.session.end()
        return []


def run(batches, until, curves, folder, **options):
    """The session after its end, and the messages that it sent."""
    outbox, messages = [], Messages(batches, until)
    settings = SessionSettings(folder / "out" / "sweep.h5", **{"importing": RF, "volume": False, **options})
    messages.session = Session(messages, [outbox.append], curves, settings)
    messages.session.run()
    return messages.session, [decode_whole(message) for message in outbox]


@pytest.fixture(scope="module")
def example(data_folder):
    sweep = s3.load_sweep(data_folder / "phantom.h5")
    return [sweep.frames[k] for k in range(14)], s3.load_curves(data_folder / "curves.h5")


def test_what_is_received_is_recorded_placed_and_sent_on(example, tmp_path):
    frames, curves = example
    batches = [[reading(9.96), reading(9.98)]]
    batches += [[image(frame, 10.0 + k / 25), reading(10.02 + k / 25)] for k, frame in enumerate(frames)]
    batches += [[reading(11.0, "StylusToReference")]]
    session, messages = run(batches, lambda p: p.poses == 14, curves, tmp_path, transform="ProbeToReference")
    assert (session.progress.frames, session.progress.left) == (14, 0)
    poses = [message for message in messages if message.device == POSE]
    assert [pose.time_s for pose in poses] == pytest.approx([10.0 + k / 25 for k in range(14)], abs=1e-6)
    sweep = s3.load_sweep(tmp_path / "out" / "sweep.h5")
    np.testing.assert_array_equal(sweep.frames[13], frames[13])
    assert sweep.frame_time_s == pytest.approx(np.arange(14) / 25)
    # Readings before the first frame are there, and another tool's are not.
    assert sweep.tracker.readings.time_s[0] == pytest.approx(-0.04)
    assert len(sweep.tracker.readings) == 16
    assert sweep.tracker.covers(sweep.frame_time_s).all()


def test_messages_that_make_no_sweep_are_counted_and_cost_nothing_else(example, tmp_path):
    frames, curves = example
    usable = [image(frame, 1.0 + k / 25) for k, frame in enumerate(frames[:4])]
    late, small = image(frames[1], 0.5), image(frames[0][:, :700], 2.0)
    shear = TransformReceived("ProbeToReference", 1.2, np.diag([1.0, 1.0, 3.0, 1.0]), True)
    session, _ = run(
        [[*usable, late, small, shear, image(frames[4], 3.0)]],
        lambda p: p.poses == 5,
        curves,
        tmp_path,
        transform="ProbeToReference",
    )
    assert (session.progress.frames, session.progress.refusals) == (5, 3)
    assert "rigid" in session.progress.last_refusal
    assert len(s3.load_sweep(tmp_path / "out" / "sweep.h5")) == 5


@pytest.mark.slow
def test_words_and_a_volume_go_out(example, tmp_path, monkeypatch):
    frames, curves = example
    monkeypatch.setattr("speckle3d.live.session.VOLUME_EVERY_S", 0.05)
    noise = np.random.default_rng(0).integers(-20, 20, frames[0].shape).astype(np.int16)
    batches = [[image(frame, float(k))] for k, frame in enumerate([*frames[:9], *[noise] * 3])]
    _, messages = run(
        batches,
        lambda p: p.poses == 12 and p.volumes > 0,
        curves,
        tmp_path,
        volume=True,
        check=True,
    )
    words = {message.type for message in messages if message.device == ADVICE}
    assert words >= {"STRING lifted"} or words >= {"STRING no speckle"}
    volumes = [message for message in messages if message.device == VOLUME]
    assert volumes[-1].pixels.ndim == 3
    assert volumes[-1].pixels.max() > 100


def test_when_placing_fails_recording_goes_on(example, tmp_path, monkeypatch):
    frames, curves = example

    def failing(*_):
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr("speckle3d.live.session.LiveTracker.append", failing)
    images = [image(frame, k / 25) for k, frame in enumerate(frames)]
    session, _ = run([images[:1], images[1:]], lambda p: p.frames == 14 and p.failure, curves, tmp_path)
    assert isinstance(session.failure, np.linalg.LinAlgError)
    assert "placing ended, recording goes on: LinAlgError('singular')" in session.progress.line
    assert len(s3.load_sweep(tmp_path / "out" / "sweep.h5")) == 14


def test_a_pose_takes_pixels_to_slicers_axes(example):
    frames, _ = example
    layout = ImageLayout.of(image(frames[0], 0.0), RF, "sweep")
    world = RigidTransform.from_translation([1.0, 2.0, 3.0])
    message = decode_whole(layout.pose_message(world, 5.0))
    # Sample 100 of vector 10: 3 mm along x and 1.155 mm deep in the image; x and y are reversed in RAS.
    at = message.matrix @ [100, 10, 0, 1]
    assert at[:3] == pytest.approx([-(1.0 + 3.0), -(2.0 + 1.155), 3.0], abs=1e-4)
    assert np.linalg.det(message.matrix[:3, :3]) > 0


def test_images_that_say_too_little_leave_no_folder(example, tmp_path):
    frames, curves = example
    with pytest.raises(MissingSettingsError, match="--sampling-rate-hz"):
        run([[image(frames[0], 0.0)]], lambda _: False, curves, tmp_path, importing=ImportSettings())
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_folders_place_is_an_error_of_files(example, tmp_path):
    frames, curves = example
    (tmp_path / "out").write_text("")
    with pytest.raises(s3.Speckle3DError):
        run([[image(frames[0], 0.0)]], lambda _: False, curves, tmp_path)
