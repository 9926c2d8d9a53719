"""Load pycolmap on demand, and convert options and names of a config to its own."""

import subprocess
import sys
from collections.abc import Mapping
from types import ModuleType
from typing import Any

from emgs_jax.data.camera_models import load_pycolmap

PROBE = """
import sys, tempfile, cv2, numpy as np, pycolmap
features, matcher = (getattr(pycolmap, kinds).__members__[name] for kinds, name in zip(sys.argv[1::2], sys.argv[2::2]))
extraction = pycolmap.FeatureExtractionOptions(type=features, use_gpu=False)
matching = pycolmap.FeatureMatchingOptions(type=matcher, use_gpu=False)
with tempfile.TemporaryDirectory() as folder:
    image = cv2.resize(np.random.default_rng(0).integers(0, 255, (40, 40), np.uint8), (320, 320))
    for name in "ab":
        cv2.imwrite(f"{folder}/{name}.png", image)
    database, cpu = f"{folder}/database.db", pycolmap.Device.cpu
    pycolmap.extract_features(database, folder, extraction_options=extraction, device=cpu)
    pycolmap.match_exhaustive(database, matching_options=matching, device=cpu)
"""


def load() -> ModuleType:
    """Import pycolmap; ValueError if it is not installed."""
    return load_pycolmap(
        "poses of images are found by pycolmap, which is not installed (for Linux on ARM there is no wheel): "
        "install it from source, or bring predictions with poses (prior=files)"
    )


def bundle_of(model: Any) -> Any:
    """pycolmap's problem of adjusting all images of a model, with nothing held constant."""
    problem = load().BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        problem.add_image(image)
    return problem


def check_kinds(features: str, matcher: str) -> None:
    """Try features and a matcher in another process, which COLMAP ends if this build lacks them; then ValueError."""
    kinds = "FeatureExtractorType", features, "FeatureMatcherType", matcher
    done = subprocess.run([sys.executable, "-c", PROBE, *kinds], capture_output=True, text=True, encoding="utf-8")
    if done.returncode:
        said = [line.removeprefix("  what():").strip() for line in done.stderr.splitlines() if line.strip()]
        reason = next((line for line in said if "ONNX" in line), said[-1] if said else "it ends without a word")
        raise ValueError(
            f"this pycolmap cannot use prior.structure.features={features.lower()} with the matcher {matcher.lower()} "
            f"({reason}): use features=sift matcher=null, or a pycolmap that is built with what they need"
        )


def options_of(name: str, *given: Mapping[str, Any]) -> Any:
    """Make an options object of pycolmap; later values win. ValueError, with the known options, for unknown ones."""
    options = getattr(load(), name)()
    for values in given:
        try:
            options.mergedict(_plain(values))
            checked = options.ransac if hasattr(options, "ransac") else options
            if hasattr(checked, "check") and checked.check() is False:
                raise ValueError("a value is out of its range")
        except (AttributeError, TypeError, ValueError, RuntimeError) as error:
            known = ", ".join(sorted(options.todict()))
            raise ValueError(
                f"prior.structure.options: {name} of pycolmap does not take {dict(values)} "
                f"({str(error).splitlines()[0]}): its options are {known}"
            ) from error
    return options


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: _plain(value) if isinstance(value, Mapping) else value for key, value in values.items()}


def member(kinds: str, name: str, key: str) -> Any:
    """A value of one of pycolmap's enumerations by its name in any case; `key` names it in errors."""
    members = {name.lower(): value for name, value in getattr(load(), kinds).__members__.items() if name != "UNDEFINED"}
    if name.lower() not in members:
        raise ValueError(f"prior.structure.{key}={name} is unknown: pycolmap has {', '.join(members)}")
    return members[name.lower()]
