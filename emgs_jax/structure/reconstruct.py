"""Reconstruct models from images by COLMAP, in a folder from which an interrupted call resumes."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from emgs_jax.data.base import BadFrameError
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.library import check_kinds, load, member, options_of
from emgs_jax.structure.mapping import Mapped, map_database
from emgs_jax.structure.pairs import choose_pairs
from emgs_jax.structure.posed import model_at
from emgs_jax.structure.shots import DATABASE, IMAGES, Shots

BATCH, PAIRS = 8, 400  # images and pairs of one call of COLMAP, so that the bar moves
FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]
SECONDS = 0.5, 0.05, 0.6  # of two cores: features of a 640x480 image, a pair, an image mapped


def map_images(shots: Shots, config: StructureConfig, folder: Path) -> Mapped:
    """Reconstruct models, the largest first, with a database in `folder`; ValueError, with a reason, if it fails."""
    folder.mkdir(parents=True, exist_ok=True)
    _say(shots, config)
    detect(shots, config, folder)
    match(shots, config, folder)
    found = None if shots.poses is None else model_at(shots, config, folder)
    return found or map_database(shots, config, folder)


def _say(shots: Shots, config: StructureConfig) -> None:
    """Announce the cost of many images."""
    count, per_image = len(shots.names), 2 * (config.overlap + config.num_similar)
    pairs = count * (count - 1) // 2 if count <= config.max_exhaustive else count * per_image // 2
    features, pair, mapped = SECONDS
    minutes = (count * (features + mapped) + pairs * pair) / 60
    if minutes > 5:
        tqdm.write(
            f"structure of {count} images: some {minutes:.0f} minutes on two cores and {count * 1.5 / 1024:.1f} GB of "
            "disk while it lasts; prior.structure.mapper=global is faster, prior.structure.model=DIR takes one"
        )


def detect(shots: Shots, config: StructureConfig, folder: Path) -> None:
    """Find the features of all images that the database lacks."""
    pycolmap = load()
    database, images = folder / DATABASE, folder / IMAGES
    images.mkdir(exist_ok=True)
    with pycolmap.Database.open(database) as opened:
        done = {image.name for image in opened.read_all_images()}
    extraction = options_of(
        "FeatureExtractionOptions",
        {"num_threads": config.num_threads, "max_image_size": config.max_image_size, "use_gpu": False},
        config.options.get("extraction", {}),
    )
    extraction.type = member("FeatureExtractorType", config.features, "features")
    if config.features.lower() != "sift" or config.matcher is not None:
        check_kinds(extraction.type.name, matcher_of(config).name)
    model, parameters = shots.camera
    reader = pycolmap.ImageReaderOptions(
        camera_model=model, camera_params=",".join(map(repr, parameters)), mask_path=_masks(shots, folder)
    )
    names = [name for name in shots.names if f"{name}.png" not in done]
    number = {name: index for index, name in enumerate(shots.names)}
    with tqdm(total=len(shots.names), initial=len(shots.names) - len(names), unit="image", desc="features") as bar:
        for start in range(0, len(names), BATCH):
            batch = [name for name in names[start : start + BATCH] if _write(shots, number[name], images)]
            if not batch:
                continue
            with pycolmap.Database.open(database) as opened:
                cameras = opened.read_all_cameras()
            reader.existing_camera_id = cameras[0].camera_id if cameras else -1
            pycolmap.extract_features(
                database,
                images,
                image_names=[f"{name}.png" for name in batch],
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )
            bar.update(len(batch))


def _write(shots: Shots, index: int, images: Path) -> bool:
    """Write an image for COLMAP; False if it cannot be read: its frame gets no pose, and the run says why."""
    try:
        image = shots.read(index)
    except BadFrameError:
        return False
    path = images / f"{shots.names[index]}.png"
    return image.shape[1::-1] == tuple(shots.size) and cv2.imwrite(str(path), image[..., ::-1], FAST)


def _masks(shots: Shots, folder: Path) -> str:
    """Write masks under COLMAP's names and return their folder, or ''; BadFrameError if one cannot be used."""
    own = folder / "masks"
    for index, name in enumerate(shots.names):
        if (is_out := shots.mask(index)) is not None:
            own.mkdir(exist_ok=True)
            cv2.imwrite(str(own / f"{name}.png.png"), np.uint8(255 * ~is_out))
    return str(own) if own.is_dir() else ""


def matcher_of(config: StructureConfig) -> Any:
    """pycolmap's FeatureMatcherType: the given one, else that of the features."""
    features = config.features.lower()
    kinds = {"sift": "sift_bruteforce", "aliked": "aliked_lightglue", "loma": features}
    return member("FeatureMatcherType", config.matcher or kinds[features.split("_")[0]], "matcher")


def match(shots: Shots, config: StructureConfig, folder: Path) -> None:
    """Match and verify the pairs of `choose_pairs`; those in the database are kept."""
    pycolmap = load()
    database, listed = folder / DATABASE, folder / "pairs.txt"
    matching = options_of(
        "FeatureMatchingOptions",
        {"num_threads": config.num_threads, "guided_matching": True, "use_gpu": False},
        config.options.get("matching", {}),
    )
    matching.type = matcher_of(config)
    verification = options_of(
        "TwoViewGeometryOptions",
        {"ransac": {"random_seed": config.seed}},
        config.options.get("verification", {}),
    )
    with pycolmap.Database.open(database) as opened:
        pairs = choose_pairs(opened, [f"{name}.png" for name in shots.names], config)
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(listed))
    with tqdm(total=len(pairs), unit="pair", desc="matches") as bar:
        for start in range(0, len(pairs), PAIRS):
            some = pairs[start : start + PAIRS]
            listed.write_text("\n".join(f"{a} {b}" for a, b in some), encoding="utf-8")
            pycolmap.match_image_pairs(
                database,
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
                device=pycolmap.Device.cpu,
            )
            bar.update(len(some))
