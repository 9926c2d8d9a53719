"""A model of images whose poses are known, up to their errors: one, in the poses' world and unit.

Nothing is mapped: points are triangulated from the poses, and both are adjusted to the matches, with the positions as
priors. The first points are wide of the mark by the poses' errors, so this is done several times, more strictly.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from emgs_jax.data.masks import stem
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.evidence import contradicted, read_evidence, trust
from emgs_jax.structure.library import bundle_of, load, options_of
from emgs_jax.structure.mapping import (
    MIN_IMAGES,
    REFUSED,
    Mapped,
    adjustment,
    cache_of,
    depths_seen,
    drop_points_at_cameras,
    filter_points,
    leave_out,
    register_rest,
)
from emgs_jax.structure.shots import DATABASE, IMAGES, Shots
from emgs_jax.structure.uncertainty import camera_in_world

MIN_POSED = 0.5  # of the images, or their poses are not used
WIDE = 8.0, 2.0, 1.0  # in each step, by which COLMAP's largest errors are multiplied
ANGLES = "create_max_angle_error", "continue_max_angle_error"
MAX_OFF = 0.2  # of the path's spread, by which positions may be off in each axis
FIRST_STD, LEAST_STD = 1e-2, 5e-4  # of a position, in median depths: before it is known, and at least
MEDIAN = 1.538  # of the length of a vector whose coordinates have a standard deviation of 1
JITTER = 1e-3  # of that standard deviation: pycolmap takes no priors that lie in a plane exactly


def model_at(shots: Shots, config: StructureConfig, folder: Path) -> Mapped | None:
    """The model at the poses of `shots`, with a database in `folder`; None if few have one or matches contradict it."""
    evidence = read_evidence(folder / DATABASE, shots.names, max(1.0, max(shots.size) / config.max_image_size))
    model = _placed(shots, config, folder)
    if model is None:
        return None
    said, priors = [], _positions(model)
    for step, wide in enumerate(WIDE):
        model = _triangulated(model, config, folder, wide)
        depths = np.concatenate([depths_seen(model, model.images[number])[1] for number in model.reg_image_ids()])
        depth = float(np.median(depths)) if len(depths) else 1.0
        std = FIRST_STD * depth if step == 0 else max(_off(model, priors), LEAST_STD * depth)
        _adjust(model, shots, config, priors, std)
        filter_points(model, config, wide)
        wrong = contradicted(model, evidence)
        if step == 0 and wrong:
            listed = _listed([stem(model.images[image].name) for image in wrong])
            said.append(f"structure: the matches contradict the poses of {listed}, which are found anew")
            priors = {image: place for image, place in priors.items() if image not in wrong}
        leave_out(model, evidence)
        if model.num_reg_images() < MIN_IMAGES:
            break
        if step < len(WIDE) - 1:
            register_rest([model], config, folder)
    off, trusted = _off(model, priors), trust([model], evidence, within=True)
    spread = float(np.linalg.norm(np.std([*priors.values()], axis=0))) if priors else 0.0
    if trusted < REFUSED or off > MAX_OFF * spread:
        tqdm.write(
            f"structure: the data set's poses are not used: {100 * trusted:.0f} % of the matches agree with them, and "
            f"positions are off by {off:.2g} m: are they of these images, camera → world, with OpenCV's axes?"
        )
        return None
    model.update_point_3d_errors()
    said.append(f"structure: at the data set's poses, whose positions are off by {off:.2g} m in each axis")
    return Mapped([model], said)


def _listed(names: list[str]) -> str:
    return f"{', '.join(sorted(names)[:5])}{' …' * (len(names) > 5)} (images in all: {len(names)})"


def _placed(shots: Shots, config: StructureConfig, folder: Path) -> Any:
    """A model of the images with poses, without points; None if they are few."""
    pycolmap, model = load(), load().Reconstruction()
    cache, names = cache_of(config, folder)
    model.load(cache)
    row, count = {name: index for index, name in enumerate(shots.names)}, 0
    for number, image in model.images.items():
        pose = shots.poses[row[stem(names[number])]] if stem(names[number]) in row else None
        if pose is not None and np.isfinite(pose).all():
            T = np.linalg.inv(pose)
            rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(T[:3, :3]), T[:3, 3])
            model.frames[image.frame_id].set_cam_from_world(image.camera_id, rigid)
            model.register_frame(image.frame_id)
            count += 1
    return model if count >= max(MIN_IMAGES, MIN_POSED * len(shots.names)) else None


def _positions(model: Any) -> dict[int, Float[np.ndarray, "3"]]:
    """The position of each image with a pose."""
    return {image: camera_in_world(model.images[image])[:3, 3] for image in model.reg_image_ids()}


def _triangulated(model: Any, config: StructureConfig, folder: Path, wide: float) -> Any:
    """The model with new points, whose errors may be `wide` times what COLMAP allows."""
    triangulation, mapper = load().IncrementalTriangulatorOptions(), load().IncrementalMapperOptions()
    angles = {kind: wide * getattr(triangulation, kind) for kind in ANGLES}
    options = options_of(
        "IncrementalPipelineOptions",
        {
            "num_threads": config.num_threads,
            "triangulation": angles | {"random_seed": config.seed},
            "mapper": {"filter_max_reproj_error": wide * mapper.filter_max_reproj_error, "random_seed": config.seed},
        },
    )
    output = folder / "models"
    for needed in (output, folder / IMAGES):
        needed.mkdir(exist_ok=True)
    return load().triangulate_points(model, folder / DATABASE, folder / IMAGES, output, True, options)


def _adjust(
    model: Any, shots: Shots, config: StructureConfig, priors: dict[int, Float[np.ndarray, "3"]], std: float
) -> None:
    """Minimise a robust loss of the matches and of the positions, each with a standard deviation `std`."""
    pycolmap = load()
    drop_points_at_cameras(model)
    rng = np.random.default_rng(config.seed)
    given = [
        pycolmap.PosePrior(
            corr_data_id=model.images[image].data_id,
            position=priors[image] + JITTER * std * rng.normal(size=3),
            position_covariance=std**2 * np.eye(3),
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image in sorted({*priors} & {*model.reg_image_ids()})
    ]
    options = adjustment(shots, config, is_center_free=False)
    of_priors = options_of("PosePriorBundleAdjustmentOptions", {"alignment_ransac": {"random_seed": config.seed}})
    of_priors.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    problem = bundle_of(model)
    pycolmap.create_pose_prior_ceres_bundle_adjuster(options, of_priors, problem, given, model).solve()


def _off(model: Any, priors: dict[int, Float[np.ndarray, "3"]]) -> float:
    """Standard deviation of the positions' coordinates from those of the model, by the median."""
    placed = sorted({*priors} & {*model.reg_image_ids()})
    off = [camera_in_world(model.images[image])[:3, 3] - priors[image] for image in placed]
    return float(np.median(np.linalg.norm(off, axis=1))) / MEDIAN if off else 0.0
