"""`python -m tools.kernels [words of a run]`: what a step launches on an H100, compiled where there is none.

It wants JAX's plugin for CUDA and the compiler's parts, not a GPU:

    pip install --no-deps --target build/cuda "jax-cuda13-plugin==VERSION" "jax-cuda13-pjrt==VERSION" \
        nvidia-cuda-nvcc nvidia-nvvm nvidia-cuda-runtime

with the version of the jax that is installed. For each executable of the step after the first window: kernels that it
launches, how many of them differ, and what compiling them takes. Times of launches are not known here.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

# An H100 SXM as the compiler describes it to itself; figures of NVIDIA's data sheet.
H100 = """
gpu_device_info {
  cuda_compute_capability { major: 9 }
  threads_per_block_limit: 1024 threads_per_warp: 32 threads_per_core_limit: 2048
  shared_memory_per_block: 49152 shared_memory_per_block_optin: 232448 shared_memory_per_core: 233472
  core_count: 132 fpus_per_core: 128 registers_per_core_limit: 65536 registers_per_block_limit: 65536
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  memory_bandwidth: 3352320000000 l2_cache_size: 52428800 clock_rate_ghz: 1.98 device_memory_size: 84942979072
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 10 patch: 4 }
device_description_str: "NVIDIA H100 80GB HBM3"
"""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.kernels", description=__doc__)
    parser.add_argument("--cuda", type=Path, default=Path("build/cuda"), help="where the plugin was installed")
    parser.add_argument("words", nargs="*", help="of a run (default: the built-in room at 320×240)")
    given = parser.parse_args()
    if not (given.cuda / "jax_plugins").is_dir():
        sys.exit(f"no plugin in {given.cuda}: see python -m tools.kernels --help")
    sys.path.append(str(given.cuda.resolve()))
    os.environ |= {"JAX_SKIP_CUDA_CONSTRAINTS_CHECK": "1", "JAX_PLATFORMS": "cpu"}
    flag = f"--xla_gpu_cuda_data_dir={(given.cuda / 'nvidia' / 'cu13').resolve()}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
    launched = compiled = 0.0
    for executable, arguments in calls(given.words):
        begin = time.process_time()
        counts, different = for_h100(executable, *arguments)
        took = time.process_time() - begin
        launched, compiled = launched + counts.total(), compiled + took
        kinds = ", ".join(f"{count:.0f} {kind}" for kind, count in counts.most_common(3))
        about = f"{counts.total():6.0f} launches ({kinds}), {different:4d} kernels, {took:5.1f} CPU s"
        print(f"{executable.__wrapped__.__name__:18} {about}", flush=True)
    print(f"{'a step':18} {launched:6.0f} launches, {compiled:.1f} CPU s of compilation")


def calls(words: list[str]) -> list[tuple[Callable, tuple]]:
    """The executables of the step after the first window, and what each is called with."""
    from emgs_jax.ops.executable import calling
    from emgs_jax.slam import step
    from tools.benchmark import load

    data = load(*words)
    noted: list[tuple[Callable, tuple]] = []

    def note(executable: Callable, *arguments: Any) -> Any:
        noted.append((executable, arguments))
        return executable(*arguments)

    with calling(note):
        step(*data)
    return noted


def for_h100(executable: Callable, *arguments: Any) -> tuple[Any, int]:
    """`kernels` of an executable for such arguments."""
    import equinox as eqx
    import jax
    from jax.experimental import topologies
    from jax.sharding import SingleDeviceSharding

    from emgs_jax.ops.precision import full_precision
    from tools.kernels.count import kernels

    device = topologies.get_topology_desc("", platform="cuda", topology="1x1x1", target_config=H100).devices[0]
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=SingleDeviceSharding(device)), dynamic
    )

    @full_precision
    def run(dynamic: Any) -> Any:
        return eqx.filter(executable.__wrapped__(*eqx.combine(dynamic, static)), eqx.is_array)

    jax.config.update("jax_enable_compilation_cache", False)  # which wants a device
    return kernels(jax.jit(run).lower(shapes).compile().as_text())


if __name__ == "__main__":
    main()
