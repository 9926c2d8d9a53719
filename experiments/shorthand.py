"""`emgs run video.mp4`: the settings that a video or a folder of images implies; given keys win."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from emgs_jax.config.overrides import written
from emgs_jax.data.reading import about_pixels

from .command import overrides_of, words_of

CAMERA = re.compile(r"camera(:.*)?$|/dev/video\d+$|(rtsp|rtmp|http|https|udp)://")
FPS = 3  # images a second of a camera, of which a structure is made
NUM_FRAMES = 150  # about as many frames of a video are taken, evenly, by each run
SECONDS = 5.0  # for an image, from COLMAP to the report, on one core


def with_source(arguments: list[str]) -> list[str]:
    """Replace the path among the arguments of `emgs run`, if any, by the keys that it implies, and print them."""
    words = [word for word in words_of(arguments).overrides if "=" not in word or CAMERA.match(word)]
    paths = [word for word in words if word[0] != "~" or word.startswith("~/")]  # ~KEY removes a key
    if not paths:
        return arguments
    if len(paths) > 1:
        raise ValueError(f"{', '.join(paths)}: give one video or folder of images, and all else as key=value")
    if CAMERA.match(paths[0]):
        return of_camera(paths[0], [word for word in arguments if word != paths[0]])
    path = Path(paths[0]).expanduser()
    if not path.exists():
        raise ValueError(f"{path} is no file or folder, and no key=value: emgs run --help lists the keys")
    given = [word for word in arguments if word != paths[0]]
    found = implied(path, keys_of(given))
    print(f"settings for {path}: {' '.join(found)} (your own win)")
    if note := plan_note(path, keys_of([*found, *given])):
        print(note)
    return [*found, *given]


def of_camera(word: str, given: list[str]) -> list[str]:
    """Put the keys that a camera implies before the given ones, and print them."""
    keys = keys_of(given)
    source = word.removeprefix("camera").removeprefix(":") or "0"
    found = {"dataset": "camera", "dataset.source": written(source)}
    if keys.get("prior", "multiview_stereo") == "multiview_stereo":
        found |= {"prior": "multiview_stereo", **({} if "baseline" in keys else {"graph": "up_to_scale"})}
        is_known = keys.get("dataset.intrinsics", "estimate") not in ("estimate", "null")
        is_online = keys.get("prior.structure.online", str(is_known)).lower() == "true"
        if is_online:
            found |= {"prior.structure.online": "true"}
        else:  # it needs all images before it begins
            found |= {"dataset.intrinsics": "estimate", "dataset.fps": str(FPS), "dataset.record": "true"}
    words = [f"{key}={value}" for key, value in found.items() if key not in keys]
    print(f"settings for camera {source}: {' '.join(words)} (your own win)")
    if "prior.structure.online" in found:
        print("move the camera sideways: the map begins when two images have parallax")
    elif "prior" in found:
        print("the images are recorded until Ctrl-C (or dataset.max_seconds=60), and mapped then; with")
        print("dataset.intrinsics=[fx,fy,cx,cy] they are mapped while they come")
    return [*words, *given]


def keys_of(arguments: Sequence[str]) -> dict[str, str]:
    return dict(word.lstrip("+~").split("=", 1) for word in overrides_of(list(arguments)))


def implied(path: Path, given: dict[str, str]) -> list[str]:
    """The overrides that a video or folder of images implies, without given keys."""
    if given.get("dataset", "images") != "images":
        return [f"dataset.root={written(str(path))}"]
    found = {"dataset": "images", "dataset.root": written(str(path)), "dataset.intrinsics": "estimate"}
    size = _size(path)
    found["dataset.size"] = "[{},{}]".format(*about_pixels(*size))
    if given.get("prior") == "files" and "prior.folder" in given and "dataset.intrinsics" not in given:
        from emgs_jax.prior.files.prior import image_intrinsics

        camera = image_intrinsics(Path(given["prior.folder"].strip("'\"")).expanduser(), size)
        if camera is not None:
            found["dataset.intrinsics"] = "[{:.6g},{:.6g},{:.6g},{:.6g}]".format(*camera)
    if given.get("prior", "multiview_stereo") == "multiview_stereo":
        found["prior"] = "multiview_stereo"
        if "baseline" not in given:  # a baseline fuses frames before the back end moves them
            found["graph"] = "up_to_scale"
        chunks = given.get("chunks", "1")
        num_frames = NUM_FRAMES * (int(chunks) if chunks.isdecimal() else 1)  # more than one run maps
        stride = round(len(chosen(path, given)) / num_frames)
        if is_video(path) and stride > 1 and given.get("prior/dense") != "files":  # files may be of every frame
            found["dataset.stride"] = str(stride)
    return [f"{key}={value}" for key, value in found.items() if key not in given]


def is_video(path: Path) -> bool:
    from emgs_jax.data.video import VIDEO_SUFFIXES

    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def chosen(path: Path, given: dict[str, str]) -> range:
    """The images of a folder, or of a video by its header, that `dataset.start`, `stop` and `stride` choose."""
    from emgs_jax.data.images import listed
    from emgs_jax.data.video import announced

    images = range(announced(path) if is_video(path) else len(listed(path)[0]))
    words = (given.get(f"dataset.{name}", "null") for name in ("start", "stop", "stride"))
    try:
        return images[slice(*(None if word == "null" else int(word) for word in words))]
    except ValueError:  # no number, or several of a multirun
        return images


def plan_note(path: Path, keys: dict[str, str]) -> str:
    """Describe how many images COLMAP and stereo will map, and how long that takes; empty for other priors."""
    if keys.get("dataset") != "images" or keys.get("prior") != "multiview_stereo":
        return ""
    every, images = len(chosen(path, keys | {"dataset.stride": "1"})), chosen(path, keys)
    minutes = max(round(len(images) * SECONDS / 60 / (os.cpu_count() or 1)), 1)
    taken = f"{len(images)} of {every} images, every {images.step}th" if images.step > 1 else f"{every} images"
    less = f"; dataset.stride={2 * images.step} halves that" if len(images) > NUM_FRAMES // 2 else ""
    size = keys["dataset.size"].strip("[]").replace(",", "×")
    return f"{taken}, at {size}: about {minutes} min on this machine{less}"


def _size(path: Path) -> tuple[int, int]:
    """(width, height) of the images in a video or folder."""
    from emgs_jax.data.images import listed
    from emgs_jax.data.reading import first_size
    from emgs_jax.data.video import Video

    if is_video(path):
        return Video(path, 1).read(0).shape[1::-1]
    return first_size(listed(path)[0], path)
