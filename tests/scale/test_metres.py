"""`scale=` on a drawn structure: a camera that walks over a floor, in a unit of its own."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hydra.errors import InstantiationException
from scene import compose
from scipy.spatial.transform import Rotation

from emgs_jax.config.configure import build, build_dataset, build_prior
from emgs_jax.scale.estimate import Scale
from emgs_jax.scale.metres import ScaleConfig, View, metres_of, read_given

UNIT, HEIGHT, FOCAL, SIZE = 0.4, 1.5, 60.0, (80, 60)  # units of a metre; metres
COUNT = 12


class Photos:
    """Frames `a00.jpg` … whose images on disk are twice as large."""

    intrinsics, size, raw_size = (FOCAL, FOCAL, 39.5, 29.5), SIZE, (160, 120)

    def __init__(self, folder):
        self.folder = folder

    def __len__(self):
        return COUNT

    def __getitem__(self, index):
        return SimpleNamespace(timestamp=float(index))

    def files(self, index):
        return [self.folder / f"a{index:02}.jpg"]

    def pixel_of(self, index, pixel):
        return (np.asarray(pixel) + 0.5) / 2 - 0.5


def poses():
    """T_world_camera in metres, z up: 1.5 m above the floor, looking 40° down, turning."""
    level = Rotation.from_matrix([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    found = np.tile(np.eye(4), (COUNT, 1, 1))
    for row in range(COUNT):
        turn = Rotation.from_euler("z", 8.0 * row, degrees=True) * level * Rotation.from_euler("x", -40, degrees=True)
        found[row, :3, :3] = turn.as_matrix()
        found[row, :3, 3] = [0.3 * row, 0.1 * row**1.5, HEIGHT + 0.02 * (-1) ** row]
    return found


TURN = Rotation.from_euler("xyz", [70, 20, -40], degrees=True).as_matrix()  # of the structure's world


def structure(world=None):
    T = poses()
    T[:, :3, 3] = UNIT * T[:, :3, 3]
    whole = np.eye(4)
    whole[:3, :3] = TURN
    return whole @ T, np.array([0] * COUNT if world is None else world)


def view(frame):
    """What frame shows of the floor, in the structure's unit; 5 m and more are not known."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    rays = np.stack([(u - 39.5) / FOCAL, (v - 29.5) / FOCAL, np.ones(u.shape)], axis=-1)
    T = poses()[frame]
    down = -(rays @ T[:3, :3].T)[..., 2]
    z = np.where(down > 0.1, T[2, 3] / np.maximum(down, 0.1), 0.0)
    mask = (z > 0) & (z < 5)
    return View(UNIT * np.where(mask, z, 0.0)[..., None] * rays, np.full(z.shape, 0.02))


def on_floor(frame, pixel):
    """The world's point in metres that a pixel of the image on disk shows."""
    u, v = (np.asarray(pixel) + 0.5) / 2 - 0.5
    T = poses()[frame]
    ray = T[:3, :3] @ [(u - 39.5) / FOCAL, (v - 29.5) / FOCAL, 1.0]
    return T[:3, 3] - ray * T[2, 3] / ray[2]


def measured(tmp_path, config, **changed):
    return metres_of(read_given(config, Photos(tmp_path)), *structure(**changed), view)


def angle(up):
    return np.degrees(np.arccos(np.clip(up @ TURN[:, 2], -1, 1)))


def tape(frame=3, metres=None, image=None):
    a, b = (30.0, 80.0), (131.0, 101.0)
    length = float(np.linalg.norm(on_floor(frame, a) - on_floor(frame, b)))
    return [image or f"a{frame:02}.jpg", *a, *b, metres or length]


def test_a_distance_between_pixels_of_the_image_on_disk(tmp_path):
    (found,) = measured(tmp_path, ScaleConfig(distance=tape()))
    assert found.scale.factor == pytest.approx(1 / UNIT, rel=0.01)
    assert found.scale.source.startswith("distance in a03.jpg (± ")


def test_a_distance_where_frames_disagree_is_less_sure(tmp_path):
    """The frame of the tape is 20 % too near in all its depths, and says 2 %."""

    def wrong(frame):
        points, std = view(frame)
        return View((0.8 if frame == 3 else 1.0) * points, std)

    (right,) = measured(tmp_path, ScaleConfig(distance=tape()))
    (found,) = metres_of(read_given(ScaleConfig(distance=tape()), Photos(tmp_path)), *structure(), wrong)
    assert found.scale.log - right.scale.log == pytest.approx(-np.log(0.8), rel=0.05)
    assert right.scale.std < 0.045 and found.scale.std > 0.2


def test_several_distances_are_more_certain(tmp_path):
    (one,), (three,) = (
        measured(tmp_path, ScaleConfig(distance=given))
        for given in ([tape()], [tape(3), tape(5), tape(7, image="a07")])
    )
    assert three.scale.std < 0.7 * one.scale.std
    assert three.scale.factor == pytest.approx(1 / UNIT, rel=0.01)


def test_the_height_above_the_floor_gives_scale_and_up(tmp_path):
    (found,) = measured(tmp_path, ScaleConfig(height=HEIGHT))
    assert found.scale.factor == pytest.approx(1 / UNIT, rel=0.01)
    assert 0.015 < found.scale.std < 0.04 and angle(found.up) < 0.5


def test_positions_give_scale_and_up(tmp_path):
    path = tmp_path / "places.txt"
    path.write_text("".join(f"a{row:02}.jpg {' '.join(map(str, T[:3, 3]))}\n" for row, T in enumerate(poses())))
    (found,) = measured(tmp_path, ScaleConfig(positions=str(path)))
    assert found.scale.factor == pytest.approx(1 / UNIT, rel=1e-4) and angle(found.up) < 0.1


def test_poses_of_the_data_set_give_scale_and_up(tmp_path):
    dataset = Photos(tmp_path)
    dataset.name, dataset.pose = "photos", lambda index: None if index == 4 else poses()[index]
    (found,) = metres_of(read_given(ScaleConfig(positions="dataset"), dataset), *structure(), view)
    assert found.scale.factor == pytest.approx(1 / UNIT, rel=1e-4) and angle(found.up) < 0.1
    assert "11 positions fit" in found.notes[0]


def test_positions_in_a_world_whose_z_axis_is_not_up_leave_up_open(tmp_path):
    """Symptom: up of poses by ARKit, whose y axis is up, or of odometry, whose z axis is ahead, lay on its side."""
    dataset = Photos(tmp_path)
    for turned in ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], [[1, 0, 0], [0, -1, 0], [0, 0, -1]]):  # y up; z down
        T = np.eye(4)
        T[:3, :3] = turned
        dataset.name, dataset.pose = "photos", lambda index, T=T: T @ poses()[index]
        (found,) = metres_of(read_given(ScaleConfig(positions="dataset"), dataset), *structure(), view)
        assert found.up is None and any("leave up open" in note for note in found.notes)
        assert found.scale.factor == pytest.approx(1 / UNIT, rel=1e-4)


def test_positions_along_a_line_leave_up_open(tmp_path):
    """Symptom: of a straight walk, up was turned about it by any angle."""
    path, rng = tmp_path / "places.txt", np.random.default_rng(0)
    T, world = structure()
    line = np.stack([0.5 * np.arange(COUNT), np.zeros(COUNT), np.full(COUNT, HEIGHT)], axis=1)
    T[:, :3, 3] = UNIT * (line + 1e-3 * rng.normal(size=line.shape)) @ TURN.T
    places = line + 0.02 * rng.normal(size=line.shape)
    path.write_text("".join(f"a{row:02}.jpg {' '.join(map(str, place))}\n" for row, place in enumerate(places)))
    (found,) = metres_of(read_given(ScaleConfig(positions=str(path)), Photos(tmp_path)), T, world, view)
    assert found.up is None and "they lie along a line, which leaves up open" in found.notes
    assert found.scale.factor == pytest.approx(1 / UNIT, rel=0.02)


def test_sources_that_disagree_are_said(tmp_path):
    length = tape()[-1]
    (found,) = measured(tmp_path, ScaleConfig(distance=tape(metres=2 * length), height=HEIGHT))
    assert any("the lengths disagree" in note for note in found.notes)
    assert found.scale.std > 0.1


def test_each_model_has_its_own_scale(tmp_path):
    config = ScaleConfig(distance=tape())
    first, second = measured(tmp_path, config, world=[0] * 6 + [1] * 6)
    assert first.scale is not None and second.scale is None
    assert "image a03.jpg of scale.distance has no pose in this model" in second.notes
    with pytest.raises(ValueError, match=r"^scale of the largest model, of 8 of 12 images: image a03.jpg of scale.dis"):
        measured(tmp_path, config, world=[0] * 4 + [1] * 8)
    with pytest.raises(ValueError, match=r"^scale: image a03.jpg of scale.distance has no pose in this model$"):
        measured(tmp_path, config, world=[0] * 3 + [-1] + [0] * 8)
    with pytest.raises(ValueError, match="no image has a pose"):
        measured(tmp_path, config, world=[-1] * 12)


def test_a_tape_outweighs_a_network_which_alone_gives_its_scale(tmp_path):
    network = Scale("the depth network", np.log(1.3 / UNIT), 0.2)
    world = [0] * 6 + [1] * 6
    tapes, nothing = (read_given(ScaleConfig(distance=one), Photos(tmp_path)) for one in (tape(), None))
    both = metres_of(tapes, *structure(world), view, [network, network])
    (by_tape,) = metres_of(tapes, *structure([0] * 12), view)
    assert both[0].scale.factor == pytest.approx(1 / UNIT, rel=0.02) and both[0].scale.std < by_tape.scale.std < 0.045
    assert both[1].scale.factor == pytest.approx(1.3 / UNIT) and both[1].scale.std == pytest.approx(0.2)
    assert both[0].scale.source.endswith("the depth network (± 20.0 %)")
    alone = metres_of(nothing, *structure(world), view, [network, network])
    assert [one.scale.factor for one in alone] == pytest.approx([1.3 / UNIT] * 2)


def test_pixels_without_depth_and_images_not_in_use_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"no depth is known at \[20, 1\] of image a03"):
        measured(tmp_path, ScaleConfig(distance=["a03", 20, 1, 60, 110, 1.0]))
    with pytest.raises(ValueError, match="image a99 is not in use: there are a00 to a11"):
        measured(tmp_path, ScaleConfig(distance=["a99", 20, 100, 60, 110, 1.0]))


def test_a_pixel_outside_of_the_image_is_named(tmp_path):
    """Symptom: "no depth is known … choose points with texture", for pixels of a larger copy of the photo."""
    with pytest.raises(ValueError, match=r"no pixel \[3000, 1000\] on disk: images are 160x120"):
        measured(tmp_path, ScaleConfig(distance=["a03", 60, 110, 3000, 1000, 1.0]))


def test_no_floor_is_said(tmp_path):
    with pytest.raises(ValueError, match="no floor was found below the cameras"):
        metres_of(
            read_given(ScaleConfig(height=1.5), Photos(tmp_path)),
            *structure(),
            lambda frame: View(*(np.zeros_like(part) for part in view(frame))),
        )


def test_a_source_that_says_nothing_of_a_walk_is_a_note(tmp_path):
    """The unit was at rest, and the frames turn."""
    path = tmp_path / "imu.csv"
    path.write_text("\n".join(f"{0.005 * row} .1 0 0 0 0 9.81" for row in range(3000)))
    (found,) = measured(tmp_path, ScaleConfig(height=HEIGHT, imu=str(path), T_imu_camera=np.eye(4).ravel()))
    assert found.scale is not None and any("tell no scale" in note for note in found.notes)


IMU = "scale.imu={folder}/imu.csv", "scale.T_imu_camera=[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]"
TAPE = "scale.distance=[{image},20,30,{column},30,1.5]"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scale.positions=dataset"], r"positions=dataset: 0 of 6 .* have a pose, and 4 .*\(scale.positions=FILE\)"),
        (["scale.positions=exif"], "positions=exif: 0 of 6 images have a GPS position .* give a file of positions"),
        (["scale.positions={folder}/none.txt"], "scale.positions=.*none.txt is no file: give one, exif or dataset"),
        (["scale.positions={folder}/places.txt"], "0 of 6 images have a position, .* begin with b1, b2, b3"),
        (["scale.imu={folder}/none.csv", IMU[1]], "scale.imu=.*none.csv is no file"),
        (IMU, "scale.imu=.*imu.csv: of 6 frames at 0.000 to 5.000 s too few are within 100.000 to 109.995 s"),
        ([IMU[0], "scale.T_imu_camera={folder}/none.yaml"], "scale.T_imu_camera=.*none.yaml is no file"),
        ([TAPE.format(image="a9", column=40)], "image a9 is not in use: there are a0 to a5"),
        ([TAPE.format(image="a2", column=90)], r"no pixel \[90, 30\] on disk: images are"),
        (["scale.height=1.5", "scale.positions=exif"], "positions=exif: 0 of 6 images"),
    ],
)
def test_a_source_that_is_not_there_ends_a_run_before_a_structure_is_made(tmp_path, words, message):
    for row in range(6):
        cv2.imwrite(str(tmp_path / f"a{row}.png"), np.full((48, 64, 3), 40 * row, np.uint8))
    (tmp_path / "places.txt").write_text("b1 0 0 0\nb2 1 0 0\nb3 1 1 0\nb4 2 1 0\n")
    (tmp_path / "imu.csv").write_text("\n".join(f"{100 + 0.005 * row} .1 0 0 0 0 9.81" for row in range(2000)))
    images = f"dataset.root={tmp_path}", "dataset.intrinsics=[60,60,31.5,23.5]"
    given = (word.replace("{folder}", str(tmp_path)) for word in words)
    config = compose("prior=multiview_stereo", "dataset=images", *images, *given)
    with pytest.raises(ValueError, match=message):
        build_prior(config, build_dataset(config))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"distance": ["a", 1, 2, 3, 4]}, r"must be \[image, x1, y1, x2, y2, metres\]"),
        ({"distance": ["a", 1, 2, 3, 4, -1.0]}, r"must be \[image, x1, y1, x2, y2, metres\]"),
        ({"distance": [["a", 1, 2, 3, 4, 1.0], ["b", 1, 2, 3, 4]]}, r"scale.distance=\['b'"),
        ({"imu": "imu.csv"}, "goes with scale.T_imu_camera"),
    ],
)
def test_what_is_given_is_checked_before_images_are_read(given, message):
    with pytest.raises(ValueError, match=message):
        ScaleConfig(**given)


def test_an_extrinsic_that_is_no_rigid_motion_is_named(tmp_path):
    path = tmp_path / "imu.txt"
    path.write_text("\n".join(f"{0.005 * row} .1 0 0 0 0 9.81" for row in range(4000)))
    with pytest.raises(ValueError, match=r"scale.T_imu_camera must be the 16 numbers"):
        measured(tmp_path, ScaleConfig(imu=str(path), T_imu_camera=[1.0] * 16))


def test_an_arm_in_millimetres_is_named(tmp_path):
    path, mounted = tmp_path / "imu.txt", np.eye(4)
    path.write_text("\n".join(f"{0.005 * row} .1 0 0 0 0 9.81" for row in range(4000)))
    mounted[:3, 3] = [30.0, 0.0, -80.0]
    with pytest.raises(ValueError, match=r"85.4 m from the unit: its translation is in metres"):
        measured(tmp_path, ScaleConfig(imu=str(path), T_imu_camera=mounted.ravel()))


def test_a_prior_with_a_unit_of_its_own_takes_no_scale_and_one_from_images_alone_does():
    config = compose("prior=simulated", "scale.height=1.5")
    with pytest.raises(ValueError, match="scale= gives metres to prior=multiview_stereo, whose unit is unknown"):
        build_prior(config, build_dataset(config))
    given = build(compose("prior=multiview_stereo", "scale.distance=[a.jpg,1,2,3,4,1.5]"), "prior")
    assert given.provenance.settings["unit"] == "m" and "a.jpg" in str(given.provenance.settings["scale"])
    assert "unit" not in build(compose("prior=multiview_stereo"), "prior").provenance.settings
    with pytest.raises(
        InstantiationException, match="online=true makes poses as images come, and scale= needs all of them"
    ):
        build(compose("prior=multiview_stereo", "prior.structure.online=true", "scale.height=1.5"), "prior")
