"""Settings of structure from motion; `options` are passed to COLMAP."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from emgs_jax.data.masks import Masks
from emgs_jax.ops.ranges import number, one_of

PARTS = ("extraction", "matching", "verification", "incremental", "global")  # of the options
# Fewer and shorter bundle adjustments: all is adjusted once more at the end.
RARE_ADJUSTMENTS = {
    "ba_global_frames_ratio": 1.3,
    "ba_global_points_ratio": 1.3,
    "ba_global_function_tolerance": 1e-6,
    "ba_local_function_tolerance": 1e-5,
}


@dataclass(frozen=True)
class StructureConfig:
    """Structure from motion by COLMAP; names and values are pycolmap's."""

    model: str | None = None  # folder of an existing model, or of numbered ones; or a COLMAP database, which is mapped
    features: str = "sift"  # FeatureExtractorType; for all but `sift` COLMAP fetches a network
    matcher: str | None = None  # FeatureMatcherType; None: brute force for `sift`, LightGlue or its own for the others
    mapper: str = one_of("incremental", "global", default="incremental")
    camera_model: str = "SIMPLE_RADIAL"  # of a lens whose distortion is refined
    refine_distortion: bool = True  # of a given camera; an estimated one is refined as a whole
    masks: Masks = field(default_factory=Masks)  # where no features are detected
    seed: int = number(0, low=0, high=2**31 - 1)
    num_threads: int = number(-1, low=-1, high=1024)  # -1: all; online one
    max_image_size: int = number(1024, low=64, high=16384)  # longer side in pixels, to which images are reduced
    max_exhaustive: int = number(50, low=2, high=10000)  # images up to which all pairs are matched
    overlap: int = number(10, low=1, high=1000)  # of more images: neighbours on each side, and powers of two beyond
    num_similar: int = number(5, low=0, high=1000)  # and images that place recognition proposes for each
    min_inliers: int = number(15, low=4, high=1000)  # of a frame that is registered at the end
    online: bool = False  # poses of the images so far, as they come, by an intrinsic calibration that is known
    median_depth: float = number(2.0, low=1e-6, high=1e6)  # of the landmarks: the unit; a given model keeps its own
    pixel_std: float = number(0.4, low=1e-3, high=100)  # least standard deviation of a keypoint
    # further options by part (extraction, matching, verification, incremental, global)
    options: Mapping[str, Any] = field(
        default_factory=lambda: {part: {} for part in PARTS} | {"incremental": RARE_ADJUSTMENTS}
    )

    def __post_init__(self) -> None:
        for part, values in self.options.items():
            if part not in PARTS or not isinstance(values, Mapping):
                raise ValueError(
                    f"prior.structure.options.{part}={values} is none of its parts: there are "
                    f"{', '.join(f'{name}.KEY=…' for name in PARTS)}"
                )
