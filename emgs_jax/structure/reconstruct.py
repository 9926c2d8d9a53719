"""Reconstruct models from images by COLMAP, in a folder from which an interrupted call resumes."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from tqdm import tqdm

from emgs_jax.data.base import BadFrameError
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.library import bundle_of, check_kinds, load, member, options_of
from emgs_jax.structure.pairs import choose_pairs

BATCH, PAIRS = 8, 400  # images and pairs of one call of COLMAP, so that the bar moves
MIN_IMAGES = 3  # of a model, that no larger one holds
MIN_FOR_CENTER = 30  # images to refine the principal point
MIN_DEPTH = 0.01  # of a point, in median depths of the image
FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]
DATABASE, IMAGES = "database.db", "images"
SECONDS = 0.5, 0.05, 0.6  # of two cores: features of a 640x480 image, a pair, an image mapped


class Shots(NamedTuple):
    """Images of one camera."""

    names: Sequence[str]  # distinct
    read: Callable[[int], np.ndarray]  # RGB uint8 (h, w, 3) of an image; raises BadFrameError
    size: tuple[int, int]  # (width, height)
    camera: tuple[str, tuple[float, ...]]  # COLMAP's model, and parameters in its pixels, or none: its default start
    is_calibrated: bool  # only the distortion may still change
    mask: Callable[[int], np.ndarray | None] = lambda _: None  # bool (h, w), True where an image is left out


def map_images(shots: Shots, config: StructureConfig, folder: Path) -> list[Any]:
    """Reconstruct models, the largest first, with a database in `folder`; ValueError, with a reason, if it fails."""
    folder.mkdir(parents=True, exist_ok=True)
    _say(shots, config)
    detect(shots, config, folder)
    match(shots, config, folder)
    return map_database(shots, config, folder)


def map_database(shots: Shots, config: StructureConfig, folder: Path) -> list[Any]:
    """Map the matches in a folder's database, and register remaining frames; ValueError, with a reason, if it fails."""
    found = find_models(shots, config, folder)
    check_found(found, shots, config, folder)
    register_rest(found, config, folder)
    for model in found:
        adjust(model, shots, config)
    return found


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


def refined_lens(shots: Shots, config: StructureConfig) -> tuple[bool, bool]:
    """Whether to refine the focal length, and the distortion."""
    return not shots.is_calibrated, not shots.is_calibrated or config.refine_distortion


def find_models(shots: Shots, config: StructureConfig, folder: Path) -> list[Any]:
    """Run the mapper; the largest model first."""
    pycolmap = load()
    is_free, is_bent = refined_lens(shots, config)
    common = {"num_threads": config.num_threads, "random_seed": config.seed}
    given = config.options.get(config.mapper, {})
    output = folder / "models"
    for needed in (output, folder / IMAGES):  # of a database alone there are none
        needed.mkdir(exist_ok=True)
    if config.mapper == "global":
        refined = {"refine_focal_length": is_free, "refine_extra_params": is_bent}
        mapper = {"mapper": {**common, "bundle_adjustment": refined}}
        options = options_of("GlobalPipelineOptions", common, mapper, given)
        found = pycolmap.global_mapping(folder / DATABASE, folder / IMAGES, output, options)
    else:
        refined = {
            "ba_refine_focal_length": is_free,
            "ba_refine_extra_params": is_bent,
            "mapper": {
                **common,
                "abs_pose_refine_focal_length": is_free,
                "abs_pose_refine_extra_params": is_bent,
            },
            "triangulation": {"random_seed": config.seed},
        }
        options = options_of("IncrementalPipelineOptions", common, refined, given)
        with tqdm(total=len(shots.names), unit="image", desc="structure") as bar:
            found = pycolmap.incremental_mapping(
                folder / DATABASE, folder / IMAGES, output, options, "", lambda: bar.update(2), bar.update
            )
    held: set[int] = set()
    models = []
    for model in sorted(found.values(), key=lambda model: -model.num_reg_images()):
        if len(new := {*model.reg_image_ids()} - held) >= MIN_IMAGES:
            models.append(model)
            held |= new
    return models


def register_rest(models: Sequence[Any], config: StructureConfig, folder: Path) -> None:
    """Register remaining images with fewer inliers."""
    pycolmap = load()
    with pycolmap.Database.open(folder / DATABASE) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions(min_num_matches=config.min_inliers))
    placed = {image for model in models for image in model.reg_image_ids()}
    options = pycolmap.IncrementalMapperOptions(
        abs_pose_min_num_inliers=config.min_inliers,
        abs_pose_refine_focal_length=False,
        abs_pose_refine_extra_params=False,
        random_seed=config.seed,
    )
    for model in models:
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(model)
        rest = [image for image in sorted(names) if image not in placed and cache.exists_image(image)]
        new = [image for image in rest if mapper.register_next_image(options, image)]
        for image in new:
            mapper.triangulate_image(pycolmap.IncrementalTriangulatorOptions(random_seed=config.seed), image)
        placed.update(new)
        mapper.end_reconstruction(False)


def adjust(model: Any, shots: Shots, config: StructureConfig) -> None:
    """Adjust a model once more with a robust loss, and the principal point of a camera that is being calibrated.

    The mapper itself uses squared residuals and holds the principal point in the middle of the image.
    """
    pycolmap, (is_free, is_bent) = load(), refined_lens(shots, config)
    drop_points_at_cameras(model)
    refined = {
        "refine_focal_length": is_free,
        "refine_principal_point": is_free and model.num_reg_images() >= MIN_FOR_CENTER,
        "refine_extra_params": is_bent,
        "print_summary": False,
    }
    options = options_of("BundleAdjustmentOptions", refined)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = config.num_threads
    problem = bundle_of(model)  # `pycolmap.bundle_adjustment` prints whatever the level of the log
    problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_ceres_bundle_adjuster(options, problem, model).solve()
    # The robust loss may have moved outliers anywhere.
    filters = options_of("IncrementalPipelineOptions", config.options.get("incremental", {})).mapper
    observations = pycolmap.ObservationManager(model)
    observations.filter_all_points3D(filters.filter_max_reproj_error, filters.filter_min_tri_angle)
    drop_points_at_cameras(model)
    model.update_point_3d_errors()


def drop_points_at_cameras(model: Any) -> None:
    """Delete points at a camera that shows them: their rays determine nothing, and no covariance would be finite."""
    for image in [image for image in model.images.values() if image.has_pose]:
        keys = [point.point3D_id for point in image.points2D if point.has_point3D()]
        pose = image.cam_from_world().matrix()
        depths = np.array([pose[2, :3] @ model.points3D[key].xyz + pose[2, 3] for key in keys])
        for key in np.array(keys)[depths < MIN_DEPTH * np.median(depths)] if keys else ():
            model.delete_point3D(int(key))


def check_found(found: Sequence[Any], shots: Shots, config: StructureConfig, folder: Path) -> None:
    """Raise ValueError, with the likeliest reason, if no model was found."""
    pycolmap = load()
    if found:
        return
    count = len(shots.names)
    with pycolmap.Database.open(folder / DATABASE) as opened:
        keypoints = [opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()]
        _, geometries = opened.read_two_view_geometries()
    few = sum(number < 50 for number in keypoints)
    kinds = [int(geometry.config) for geometry in geometries]
    turned = sum(kind in (4, 5, 6) for kind in kinds)  # planar or a rotation alone
    if count < 3:
        reason = f"{count} images are too few: give 3 or more of one place (dataset.stop, dataset.stride)"
    elif few > count / 2:
        masked = " and masks.folder" if config.masks.folder is not None else ""
        reason = f"{few} of {len(keypoints)} images show hardly anything to recognise: check the images{masked}"
    elif not geometries:
        reason = "no two images share enough: take them closer together (dataset.stride)"
    elif turned > len(kinds) / 2:
        reason = (
            f"{turned} of {len(kinds)} pairs of images differ by a rotation or show one plane, which tells no depth: "
            "move the camera sideways, or take images farther apart (dataset.stride)"
        )
    else:
        reason = "no pair of images has parallax to begin with: take images farther apart (dataset.stride)"
    raise ValueError(f"prior=multiview_stereo finds no structure: {reason}; or bring predictions (prior=files)")
