"""Settings of the structure; what is not named here passes through to COLMAP in its own words."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from emgs_jax.data.masks import Masks
from emgs_jax.ops.ranges import number, one_of

PARTS = ("extraction", "matching", "verification", "incremental", "global")  # of the options
# Fewer and shorter adjustments in between: all is adjusted once more in the end.
RARE_ADJUSTMENTS = {
    "ba_global_frames_ratio": 1.3,
    "ba_global_points_ratio": 1.3,
    "ba_global_function_tolerance": 1e-6,
    "ba_local_function_tolerance": 1e-5,
}


@dataclass(frozen=True)
class StructureConfig:
    """How COLMAP makes a structure of the images; names and values are pycolmap's.

    Args:
        model: folder of a model, or of several numbered ones, that is taken as it is; or a COLMAP database, which is
            mapped. None: all is computed.
        features: FeatureExtractorType; `sift` needs no file, for the others COLMAP fetches a network.
        matcher: FeatureMatcherType; None: brute force for `sift`, LightGlue or its own for the others.
        mapper: `incremental` or `global`.
        camera_model: of the lens, where its distortion is refined.
        refine_distortion: of a camera that is given; one that is estimated is refined as a whole.
        masks: in what they leave out nothing is looked for.
        seed: of all that is drawn.
        num_threads: -1: all.
        max_image_size: pixels of the longer side; larger images are searched smaller.
        max_exhaustive: images; as many as these are matched each with each, more with their neighbours and what place
            recognition proposes.
        overlap: neighbours on each side; and one at each power of two beyond.
        num_similar: images that place recognition proposes for each.
        options: further options by part (extraction, matching, verification, incremental, global), in pycolmap's words.
        min_inliers: of a frame that no model holds, registered in the end with fewer than the mapper asks for.
        max_gap: frames; one that is still without a pose is interpolated between neighbours so near, without points.
        median_depth: of what a model's images show; its unit, since images do not tell the scale. A model that is
            given keeps its own.
        pixel_std: least standard deviation of a keypoint; that of the residuals where it is larger.
    """

    model: str | None = None
    features: str = "sift"
    matcher: str | None = None
    mapper: str = one_of("incremental", "global", default="incremental")
    camera_model: str = "SIMPLE_RADIAL"
    refine_distortion: bool = True
    masks: Masks = field(default_factory=Masks)
    seed: int = number(0, low=0, high=2**31 - 1)
    num_threads: int = number(-1, low=-1, high=1024)
    max_image_size: int = number(1024, low=64, high=16384)
    max_exhaustive: int = number(50, low=2, high=10000)
    overlap: int = number(10, low=1, high=1000)
    num_similar: int = number(5, low=0, high=1000)
    min_inliers: int = number(15, low=4, high=1000)
    max_gap: int = number(3, low=0, high=1000)
    median_depth: float = number(2.0, low=1e-6, high=1e6)
    pixel_std: float = number(0.4, low=1e-3, high=100)
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
