"""A submap that begins amid a run: what it has seen, it saw at its own time."""

from dataclasses import replace
from types import SimpleNamespace

import jax.numpy as jnp
import jaxlie
import numpy as np
from scene import compose

from emgs_jax.back_end.state import BackEnd, Node
from emgs_jax.config.configure import build, graph_config
from emgs_jax.gaussian_map import empty_map
from emgs_jax.mapping import tracking
from emgs_jax.mapping.atlas import Atlas, Submap
from emgs_jax.motion import no_looks
from emgs_jax.observation import Observation, Prediction, no_covariance, unknown_scale
from emgs_jax.ops.camera import Camera, pixel_grid, rays
from emgs_jax.registration.pose_estimate import exact_estimate
from emgs_jax.slam import SlamState

TIME = 12  # of the frame that the submap begins with


def test_the_first_look_of_a_later_submap_has_the_time_of_its_frame():
    """Symptom: it had time 0, so what moved was written into the record of the first frame."""
    config = compose("graph=default", "slam/motion=default", "slam.observation.thin=1")
    slam, graph, camera = build(config, "slam"), graph_config(config), Camera((20.0, 20.0), (15.5, 11.5), 32, 24)
    points = 2.0 * rays(camera, pixel_grid(camera)).reshape(-1, 3)
    count = len(points)
    wall = Observation(
        *(points, jnp.zeros((count, 3)), jnp.tile(jnp.array([0.0, 0.0, -1.0]), (count, 1)), jnp.ones((count, 2))),
        *(jnp.ones(count), jnp.ones(count, bool)),
    )
    here, nothing = jaxlie.SE3.identity(), no_looks(wall, slam.motion)
    before = SlamState(empty_map(64, 2), wall, here, exact_estimate(), jnp.asarray(TIME), nothing)
    nodes = tuple(Node(np.eye(4), np.eye(4), 0.0, row) for row in range(TIME))
    end = replace(BackEnd(graph, (20.0, 20.0, 15.5, 11.5), 0.01), nodes=nodes)
    prediction = Prediction(
        current=wall,
        previous=wall,
        T_world_views=jaxlie.SE3(jnp.tile(here.wxyz_xyz, (3, 1))),
        T_world_anchor=here,
        pose_covariance=no_covariance(),
        scale_std=unknown_scale(),
        has_newest=jnp.asarray(False),
        is_repeat=jnp.asarray(False),
    )
    frame = SimpleNamespace(index=TIME, name="12.png")
    known = {"T_anchor_views": {TIME: np.eye(4)}, "T_world_anchor": np.eye(4)}
    window = SimpleNamespace(prediction=prediction, world=1, frames=[frame], **known)
    began = tracking.begin(Atlas(camera, slam, end, {0: Submap(before)}), window).state
    assert int(began.time) == TIME + 1
    looks = np.asarray(began.looks.time)
    assert looks[0] == TIME and (looks[1:] == -1).all()
