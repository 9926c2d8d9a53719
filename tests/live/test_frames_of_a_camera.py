"""Frames of a camera: sources that a test controls, against what they gave."""

import os
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from queue import Queue

import cv2
import numpy as np
import pytest

from emgs_jax.data.base import BadFrameError, wait_for_all
from emgs_jax.data.camera_models import Calibration
from emgs_jax.data.images import Images
from emgs_jax.data.intrinsics import Pictures, find_lens
from emgs_jax.data.readable import ReadableFrames
from emgs_jax.live import camera, capture
from emgs_jax.live.camera import Camera
from emgs_jax.live.newest import Newest, Shot, all_closed, end_all

INTRINSICS = (40.0, 40.0, 15.5, 11.5)


def an_image(shade: int, size=(32, 24)) -> np.ndarray:
    return np.full((size[1], size[0], 3), shade, np.uint8)


class Source:
    """A source that gives an image when it is told to."""

    def __init__(self, monkeypatch) -> None:
        self._given, self._next = [], threading.Semaphore(0)
        monkeypatch.setattr(capture, "open_source", lambda source, into: self._shots())

    def give(self, *shots: Shot | None | Exception) -> None:
        for shot in shots:
            self._given.append(shot)
            self._next.release()

    def _shots(self):
        while True:
            self._next.acquire()
            shot = self._given.pop(0)
            if shot is None:
                return
            if isinstance(shot, Exception):
                raise shot
            yield shot


@pytest.fixture
def source(monkeypatch):
    found = Source(monkeypatch)
    yield found
    end_all()
    found.give(Shot(1e9, an_image(0)))  # its thread sees that no more are wanted


def until(is_true) -> None:
    for _ in range(500):
        if is_true():
            return
        time.sleep(0.01)
    raise AssertionError("it does not happen")


def test_the_newest_image_is_taken_and_those_that_it_replaced_are_counted():
    newest = Newest()
    for number in range(5):
        assert newest.put(Shot(float(number), an_image(number)))
    assert newest.take(1.0).time == 4.0 and newest.num_dropped == 4
    begin = time.monotonic()
    assert newest.take(0.05) is None and 0.04 < time.monotonic() - begin < 5.0
    newest.put(Shot(5.0, an_image(5)))
    newest.end("enough"), newest.end("later")
    assert newest.take(1.0).time == 5.0, "the last one is not lost"
    assert newest.take(1.0) is None and newest.reason == "enough" and newest.num_dropped == 4
    assert not newest.put(Shot(6.0, an_image(6)))


def test_only_the_image_that_is_taken_is_read_and_one_that_is_damaged_is_passed_over():
    """Symptom: a recording at 30 images a second took a sixth of a core to decode those that were dropped."""
    newest, read = Newest(), []

    def unread(number: int):
        def shot() -> Shot:
            read.append(number)
            if number == 1:
                raise BadFrameError("image 1 is damaged")
            return Shot(float(number), an_image(number))

        return shot

    for number in range(2):
        newest.put(unread(number))
    begin = time.monotonic()
    assert newest.take(0.2) is None and time.monotonic() - begin < 5 and newest.problem == "image 1 is damaged"
    before = time.monotonic()
    for number in range(2, 5):
        newest.put(unread(number))
    came = time.monotonic()
    time.sleep(0.05)
    shot = newest.take(1.0)
    assert shot.time == 4.0 and read == [1, 4] and newest.num_dropped == 3 and newest.problem is None
    assert before <= shot.arrived <= came, "when it came, not when it was read"


def test_an_error_ends_the_thread_that_waits_for_images(tmp_path):
    """Also that of a recording whose images nobody has asked for."""
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{0.1 * number:.6f}.png"), an_image(number))
    named = f"camera {tmp_path}"
    with pytest.raises(ValueError, match="an error"), all_closed():
        Camera(source=str(tmp_path), intrinsics=INTRINSICS)
        assert named in {thread.name for thread in threading.enumerate()}
        raise ValueError("an error")
    assert named not in {thread.name for thread in threading.enumerate()}


def test_a_recorded_image_that_cannot_be_read_ends_the_recording(tmp_path):
    cv2.imwrite(str(tmp_path / "1.0.png"), an_image(0))
    (tmp_path / "1.1.png").write_bytes(b"no image")
    cv2.imwrite(str(tmp_path / "9.0.png"), an_image(0))
    into = Newest()
    capture.start(str(tmp_path), into)
    into.begun.set()
    assert into.take(5.0).time == 1.0 and into.take(5.0) is None
    assert into.reason.startswith(f"camera {tmp_path} has failed: ") and "1.1.png" in into.reason


def test_frames_come_one_by_one_and_their_number_is_not_known_before_the_end(source):
    source.give(Shot(10.0, an_image(1)))
    frames = ReadableFrames(Camera(source="0", intrinsics=INTRINSICS, size=(32, 24)))
    assert len(frames) == 1 and frames.total is None and frames.intrinsics == INTRINSICS
    threading.Timer(0.2, source.give, [Shot(10.5, an_image(2))]).start()
    begin = time.monotonic()
    assert frames.has(1) and time.monotonic() - begin > 0.1, "it waits for the image"
    assert [frames[row].timestamp for row in (0, 1)] == [10.0, 10.5]
    assert [int(frames[row].image[0, 0, 0]) for row in (0, 1)] == [1, 2]
    source.give(None)
    assert not frames.has(2) and frames.total == len(frames) == 2 and frames.kept == [0, 1]
    assert not frames.has(2)


def test_images_that_come_while_none_is_asked_for_are_dropped_but_for_the_newest(source):
    source.give(Shot(0.0, an_image(0)))
    frames = Camera(source="0", intrinsics=INTRINSICS, size=(32, 24))
    assert frames.progress_words(0) == "" and frames.report() == {}, "nothing is mapped yet"
    frames._is_live = True
    source.give(*(Shot(0.1 * number, an_image(number)) for number in range(1, 7)))
    until(lambda: frames._newest.num_dropped == 5)
    assert frames.has(1) and int(frames[1].image[0, 0, 0]) == 6
    words = [frames.progress_words(index) for index in (0, 1)]
    assert "5 dropped" in words[1] and " s behind" in words[1]
    assert frames.report()["camera/num_dropped"] == 5 and 0 <= frames.report()["camera/median_latency_s"] < 60


def test_mapping_begins_with_the_newest_image(source):
    source.give(Shot(0.0, an_image(0)))
    frames = ReadableFrames(Camera(source="0", intrinsics=INTRINSICS, size=(32, 24)), "skip")
    frames._dataset._begin -= 100.0  # such as a compilation
    source.give(Shot(1.0, an_image(7)))
    until(lambda: frames._dataset._newest._shot is not None)
    frames.begin()
    assert len(frames) == 1 and int(frames[0].image[0, 0, 0]) == 7 and frames.report()["camera/num_dropped"] == 0
    assert time.monotonic() - frames._dataset._begin < 1.0, "dataset.max_seconds counts from here"
    assert len([*frames.files(0)[0].parent.iterdir()]) == 1


@pytest.mark.parametrize(
    ("last", "words"),
    [
        (None, "camera 7 has ended"),
        (OSError("unplugged"), "camera 7 has failed: unplugged"),
        (Shot(2.0, an_image(2, (64, 48))), "camera 7 gave images of 32x24, and now images of 64x48"),
    ],
)
def test_a_camera_that_ends_fails_or_changes_its_size_gives_no_more_frames_and_says_why(source, last, words):
    source.give(Shot(0.0, an_image(0)))
    frames = Camera(source="7", intrinsics=INTRINSICS)
    source.give(last)
    assert not frames.has(1) and frames._newest.reason == words and frames.total == 1
    assert frames[0].image is not None


def test_a_camera_that_stalls_gives_no_more_frames(source, monkeypatch):
    monkeypatch.setattr(camera, "NEXT_S", 0.1)
    source.give(Shot(0.0, an_image(0)))
    frames = Camera(source="7", intrinsics=INTRINSICS)
    assert not frames.has(1) and frames._newest.reason == "camera 7 has given none for 0.1 s"


@pytest.mark.parametrize(("given", "words"), [((), "gives no image in 0.1 s"), ((None,), "has ended")])
def test_a_camera_without_an_image_is_an_error(source, monkeypatch, given, words):
    monkeypatch.setattr(camera, "FIRST_S", 0.1)
    source.give(*given)
    with pytest.raises(ValueError, match=f"camera 7 {words}"):
        Camera(source="7", intrinsics=INTRINSICS)


def test_a_camera_that_is_not_there_names_those_that_are():
    with pytest.raises(ValueError, match=r"camera /dev/nothing cannot be opened: .* \(devices: "):
        Camera(source="/dev/nothing", intrinsics=INTRINSICS)


class Device:
    """A camera of OpenCV's that gives so many images, and then ends or fails."""

    def __init__(self, num_images: int, error: Exception | None = None) -> None:
        self._left, self._error, self.is_released = num_images, error, False

    def isOpened(self) -> bool:  # noqa: N802 (OpenCV's name)
        return True

    def set(self, *_) -> None:
        pass

    def read(self):
        time.sleep(0.05)
        self._left -= 1
        if self._left < 0 and self._error is not None:
            raise self._error
        return (True, an_image(self._left)) if self._left >= 0 else (False, None)

    def release(self) -> None:
        self.is_released = True


def test_a_camera_that_another_program_holds_is_named(monkeypatch):
    """Symptom: V4L2 opens it, and the first image never comes: "camera 0 has ended"."""
    device = Device(0)
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: device)
    with pytest.raises(ValueError, match="camera 0 has failed: it is there and gives no image, as where another"):
        Camera(source="0", intrinsics=INTRINSICS)
    until(lambda: device.is_released)


@pytest.mark.parametrize(
    ("error", "words"), [(None, "camera 0 has ended"), (cv2.error("no bandwidth"), "camera 0 has failed: no bandwidth")]
)
def test_a_device_that_is_unplugged_is_released_and_its_frames_stay(monkeypatch, error, words):
    device = Device(3, error)
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: device)
    frames = Camera(source="0", intrinsics=INTRINSICS, size=(32, 24))
    assert 1 <= wait_for_all(frames) <= 3 and words in frames._newest.reason
    until(lambda: device.is_released)
    assert frames[0].image.shape == (24, 32, 3)


def test_a_camera_of_the_network_that_stalls_gives_no_more_frames(monkeypatch):
    """A real stream of JPEG images over HTTP, on this machine; its server falls silent after some."""
    monkeypatch.setattr(camera, "NEXT_S", 1.0)
    is_over = threading.Event()

    class Stream(BaseHTTPRequestHandler):
        def do_GET(self) -> None:  # noqa: N802 (the library's name)
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
            self.end_headers()
            for number in range(40):
                image = cv2.imencode(".jpg", an_image(5 * number, (64, 48)))[1].tobytes()
                head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(image)}\r\n\r\n"
                self.wfile.write(head.encode() + image + b"\r\n")
                time.sleep(0.03)
            is_over.wait(60)

        def log_message(self, *_) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Stream) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            address = f"http://127.0.0.1:{server.server_port}/stream.mjpg"
            frames = Camera(source=address, intrinsics=(80.0, 80.0, 31.5, 23.5), size=(64, 48))
            assert wait_for_all(frames) > 1
        finally:
            is_over.set()
            server.shutdown()
    assert "has given none for 1 s" in frames._newest.reason
    assert np.diff([frames[row].image.mean() for row in range(len(frames))]).min() > 0, "in order, none twice"


def test_an_iterator_of_python_is_a_source():
    """As docs/live.md says; whatever fails in it ends the frames with its reason."""
    images = Queue()
    frames = Camera(source=iter(fed(images, Shot(5.0, an_image(5))).get, None), intrinsics=INTRINSICS, size=(32, 24))
    fed(images, Shot(6.0, an_image(6), {"T_world_camera": np.eye(4)}))
    assert frames.has(1) and [frames[row].timestamp for row in (0, 1)] == [5.0, 6.0]
    np.testing.assert_array_equal(np.load(path_beside(frames, 1))["T_world_camera"], np.eye(4))
    fed(images, None)
    assert not frames.has(2) and frames._newest.reason == "camera iterator has ended"

    def broken():
        yield Shot(0.0, an_image(0))
        raise KeyError("depth")

    frames = Camera(source=broken(), intrinsics=INTRINSICS)
    assert not frames.has(1) and frames._newest.reason == "camera iterator has failed: 'depth'"


def fed(images: Queue, image: Shot | None) -> Queue:
    images.put(image)
    return images


@pytest.mark.parametrize("given", [None, "exif"])
def test_intrinsics_that_a_camera_cannot_tell_are_asked_for_before_it_is_opened(given):
    with pytest.raises(ValueError, match=r"dataset.intrinsics is not set: give \[fx,fy,cx,cy\]"):
        Camera(source="/dev/nothing", intrinsics=given)


@pytest.mark.parametrize(
    ("most", "words"),
    [
        ({"max_frames": 1}, "max_frames=1 are taken"),
        ({"max_seconds": 0.0}, "max_seconds=0 have passed"),
    ],
)
def test_it_ends_after_so_many_images_or_seconds_and_says_so_once(source, most, words, capsys):
    source.give(*(Shot(float(number), an_image(number)) for number in range(2)))
    frames = Camera(source="0", intrinsics=INTRINSICS, **most)
    assert not frames.has(1) and not frames.has(1) and frames.total == 1
    assert capsys.readouterr().out == f"no more images: dataset.{words}\n" and not end_all(), "none is running"


def test_all_cameras_of_the_process_can_be_ended(source):
    source.give(Shot(0.0, an_image(0)))
    frames = Camera(source="0", intrinsics=INTRINSICS)
    threading.Timer(0.1, end_all).start()
    assert not frames.has(1) and frames._newest.reason == "ended by the user"


def test_no_more_images_a_second_are_taken_than_asked_for(source):
    source.give(Shot(0.0, an_image(0)))
    frames, is_over = Camera(source="0", intrinsics=INTRINSICS, fps=5.0), threading.Event()

    def give() -> None:
        while not is_over.wait(0.02):
            source.give(Shot(time.monotonic(), an_image(1)))

    threading.Thread(target=give, daemon=True).start()
    assert frames.has(4)
    is_over.set()
    assert (np.diff(frames._arrived) >= 0.2).all()


def test_to_estimate_intrinsics_all_images_are_taken_first(source):
    seen = []

    def estimate(pictures):
        seen.append([int(pictures.read(row)[0, 0, 0]) for row in range(pictures.count)])
        return Calibration(INTRINSICS), {"source": "estimate"}

    source.give(Shot(0.0, an_image(0)))
    threading.Timer(0.1, lambda: [source.give(Shot(1.0, an_image(1))), time.sleep(0.3), source.give(None)]).start()
    frames = Camera(source="0", intrinsics=estimate, size=(32, 24))
    assert seen == [[0, 1]] and frames.total == 2 == wait_for_all(frames) and frames.intrinsics == INTRINSICS


def path_beside(frames: Camera, index: int):
    return frames.files(index)[0].with_suffix(".npz")


BENT = (20.0, 20.0, 15.5, 11.5, -0.2, 0.05, 0.0, 0.0)  # a lens whose distortion shows in an image of 32 by 24
RAMP = np.linspace(1, 2, 24 * 32, dtype=np.float32).reshape(24, 32)


def test_a_recording_is_read_again_as_the_same_frames_with_what_came_beside_them(source, tmp_path):
    """Without the distortion, of the images and of the depths that are registered to them."""
    given = {"depth": RAMP, "T_world_camera": np.eye(4)}
    image = np.repeat(np.uint8(100 * RAMP)[..., None], 3, axis=2)
    source.give(Shot(1764.0, image, given))
    frames = Camera(source="0", intrinsics=BENT, record=True, folder=tmp_path)
    source.give(Shot(1764.25, image, given), None)
    assert wait_for_all(frames) == 2
    settings = frames.recording()
    assert settings.pop("_target_") == "emgs_jax.data.images.Images" and settings["root"] == str(tmp_path / "recorded")
    again = Images(**settings)
    assert len(again) == 2 and again.fingerprint() == frames.fingerprint() and again.intrinsics == frames.intrinsics
    lens = find_lens(BENT, Pictures((32, 24), 1, lambda _: image))
    for row in range(2):
        assert again[row].timestamp == frames[row].timestamp and again[row].name == frames[row].name
        np.testing.assert_array_equal(again[row].image, frames[row].image)
        np.testing.assert_array_equal(again.full(row), lens.straighten(image))
        beside = np.load(again.files(row)[0].with_suffix(".npz"))
        np.testing.assert_array_equal(beside["depth"], lens.straighten_depth(RAMP))
    assert (lens.straighten_depth(RAMP) != RAMP).any()
    by_file = Images(**settings | {"intrinsics": str(tmp_path / "recorded" / "camera.json")})
    assert by_file.fingerprint() == again.fingerprint() and by_file.intrinsics == again.intrinsics
    with pytest.raises(ValueError, match="holds an earlier recording: map it"):
        Camera(source="0", intrinsics=BENT, record=True, folder=tmp_path)


@pytest.mark.parametrize("form", [lambda *four: four, lambda fx, fy, cx, cy: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]])
def test_intrinsics_beside_a_bent_image_are_replaced_by_those_of_the_straight_one(source, form):
    """Symptom: the depth was straightened and kept the intrinsics of the bent image; points lay 8 pixels off."""
    given = {"depth": RAMP, "T_world_camera": np.eye(4)}
    source.give(Shot(0.0, an_image(0), given | {"intrinsics": np.array(form(*BENT[:4]))}))
    frames = Camera(source="0", intrinsics=BENT)
    assert frames.full_intrinsics[0] < BENT[0] - 1 and sorted(given) == sorted(np.load(path_beside(frames, 0)))
    source.give(Shot(1.0, an_image(1), given | {"intrinsics": np.array(form(*frames.full_intrinsics))}))
    assert not frames.has(1) and "are not those of the images, [20.0, 20.0" in frames._newest.reason


def test_intrinsics_beside_an_image_without_distortion_stay(source):
    given = {"depth": RAMP[::2, ::2], "T_world_camera": np.eye(4), "intrinsics": np.array([20.0, 20.0, 7.5, 5.5])}
    source.give(Shot(0.0, an_image(0), given))
    frames = Camera(source="0", intrinsics=INTRINSICS)
    np.testing.assert_array_equal(np.load(path_beside(frames, 0))["intrinsics"], given["intrinsics"])


@pytest.mark.parametrize(
    ("intrinsics", "words"),
    [(BENT, "the depth of camera 0 has not the size of its images"), (lambda _: None, "not estimate")],
)
def test_depth_that_cannot_be_straightened_with_its_image_is_refused(source, intrinsics, words):
    source.give(Shot(0.0, an_image(0), {"depth": RAMP[::2]}))
    with pytest.raises(ValueError, match=words):
        Camera(source="0", intrinsics=intrinsics)


def test_a_full_disk_ends_the_camera_and_not_the_run(source, monkeypatch):
    source.give(Shot(0.0, an_image(0)))
    frames = Camera(source="0", intrinsics=INTRINSICS)
    monkeypatch.setattr(camera, "atomic_write", lambda path, **_: (_ for _ in ()).throw(OSError("no space left")))
    source.give(Shot(1.0, an_image(1)))
    assert not frames.has(1) and frames._newest.reason == "no space left" and frames.total == 1


def test_times_finer_than_names_can_say_do_not_overwrite_images(source):
    source.give(Shot(10.0000004, an_image(0)))
    frames = Camera(source="0", intrinsics=INTRINSICS)
    for number in (1, 2):
        source.give(Shot(10.0000004, an_image(number)))
        assert frames.has(number)
    assert [int(frames[row].image[0, 0, 0]) for row in range(3)] == [0, 1, 2] and len({*frames._images}) == 3


def test_a_clock_that_is_set_back_keeps_the_order(source):
    source.give(Shot(10.0, an_image(0)))
    frames = Camera(source="0", intrinsics=INTRINSICS)
    source.give(Shot(9.0, an_image(1)), None)
    assert wait_for_all(frames) == 2 and frames[1].timestamp > frames[0].timestamp


def test_the_last_image_is_not_read_again_and_is_as_it_is_on_the_disk(source, monkeypatch):
    drawn = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)
    source.give(Shot(0.0, drawn))
    frames = Camera(source="0", intrinsics=INTRINSICS, size=(32, 24))
    with monkeypatch.context() as patch:
        patch.setattr("emgs_jax.data.straightened.read_shown", lambda *_: pytest.fail("it is read"))
        last = frames[0].image
    source.give(Shot(1.0, an_image(1)))
    assert frames.has(1)
    np.testing.assert_array_equal(last, drawn)
    np.testing.assert_array_equal(frames[0].image, drawn)


@pytest.mark.parametrize("record", [False, True])
def test_only_a_recording_waits_for_the_disk(source, tmp_path, monkeypatch, record):
    """Symptom: a tenth of the time went to make images outlive a power cut that are deleted when the run ends."""
    synced = []
    monkeypatch.setattr(os, "fsync", synced.append)
    source.give(Shot(0.0, an_image(0), {"depth": np.ones((24, 32), np.float32)}))
    Camera(source="0", intrinsics=INTRINSICS, record=record, folder=tmp_path)
    assert len(synced) == (3 if record else 0), "image, depth and intrinsics"


def test_the_last_frame_can_be_left_out_as_if_it_had_not_come(source):
    given = {"depth": np.ones((24, 32), np.float32)}
    source.give(Shot(0.0, an_image(0)))
    camera = Camera(source="0", intrinsics=INTRINSICS, size=(32, 24))
    frames = ReadableFrames(camera)
    source.give(Shot(0.1, an_image(1), given))
    assert frames.has(1) and frames[1].image[0, 0, 0] == 1
    path = camera.files(1)[0]
    num_dropped = camera._newest.num_dropped
    frames.drop_last()
    assert len(frames) == 1 and not path.exists() and not path.with_suffix(".npz").exists()
    source.give(Shot(0.2, an_image(2)))
    assert frames.has(1) and len(frames) == 2
    assert frames[1].image[0, 0, 0] == 2 and frames[1].timestamp == 0.2 and frames[0].image[0, 0, 0] == 0
    assert camera._newest.num_dropped == num_dropped + 1


def test_images_that_are_not_recorded_are_deleted(source):
    source.give(Shot(0.0, an_image(0)))
    frames = Camera(source="0", intrinsics=INTRINSICS)
    folder = frames.files(0)[0].parent
    assert folder.is_dir() and frames.recording() is None
    end_all()
    del frames
    until(lambda: not folder.exists())


def test_a_recorded_folder_and_a_video_are_played_at_the_pace_of_their_times(tmp_path):
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{5 + 0.1 * number:.6f}.png"), an_image(number))
    np.savez(tmp_path / "5.100000.npz", depth=np.ones((2, 2), np.float32), other=np.zeros(1))
    into, shots = Newest(), []
    waiting = capture.open_source(str(tmp_path), into)
    shots.append((0.0, next(waiting)()))
    time.sleep(0.3)  # such as a compilation: a recording waits until images are wanted
    into.begun.set()
    begin = time.monotonic()
    for shot in waiting:
        shots.append((time.monotonic() - begin, shot()))
    late = [at - (shot.time - 5.0) for at, shot in shots]
    assert [int(shot.image[0, 0, 0]) for _, shot in shots] == [0, 1, 2, 3] and min(late) >= 0 and max(late) < 0.2
    assert shots[0][1].given is None and [*shots[1][1].given] == ["depth"]

    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
    for number in range(3):
        writer.write(an_image(80 * number))
    writer.release()
    begin, times = time.monotonic(), []
    for shot in capture.open_source(str(path), into):
        times.append((time.monotonic() - begin, shot.time))
    assert [round(found, 3) for _, found in times] == [0.0, 0.1, 0.2] and times[-1][0] >= 0.2
