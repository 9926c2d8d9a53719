"""Oracles: the arrays that were written, by this package and by others, and every cut of a file is noticed."""

import numpy as np
import pytest

from emgs_jax.evaluation.clouds import read_cloud
from emgs_jax.io.ply import save_points_ply
from emgs_jax.io.ply_reader import num_faces, read_vertices


@pytest.fixture
def points():
    return np.random.default_rng(0).normal(size=(40, 3))


@pytest.fixture
def written(tmp_path, points):
    save_points_ply(tmp_path / "a.ply", points, -points, np.abs(points) / 4)
    return tmp_path / "a.ply"


def body_of(path):
    header, body = path.read_bytes().split(b"end_header\n", 1)
    return header + b"end_header\n", body


def test_what_was_written_is_read(written, points):
    found = read_vertices(written)
    np.testing.assert_array_equal(np.stack([found[name] for name in "xyz"], 1), points.astype(np.float32))
    assert {name: array.dtype.str for name, array in found.items()}["red"] == "|u1"
    np.testing.assert_allclose(found["nx"], -points[:, 0], rtol=1e-6)


@pytest.mark.parametrize("is_ascii", [True, False])
def test_what_open3d_writes_is_read_as_open3d_reads_it(tmp_path, points, is_ascii):
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(-points)
    cloud.colors = o3d.utility.Vector3dVector(np.abs(points) / 4)
    o3d.io.write_point_cloud(str(tmp_path / "a.ply"), cloud, write_ascii=is_ascii)
    cloud, found = o3d.io.read_point_cloud(str(tmp_path / "a.ply")), read_cloud(tmp_path / "a.ply", 8)
    cloud.normalize_normals()
    for name in ("points", "normals", "colors"):
        np.testing.assert_allclose(getattr(found, name), np.asarray(getattr(cloud, name)), rtol=1e-15, err_msg=name)


def test_a_mesh_has_points_and_the_big_end_may_come_first(tmp_path, points):
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=1)
    for encoding in ("binary", "ascii"):
        mesh.export(tmp_path / "mesh.ply", encoding=encoding)
        found = read_vertices(tmp_path / "mesh.ply")
        np.testing.assert_allclose(np.stack([found[name] for name in "xyz"], 1), mesh.vertices, atol=1e-6)
        assert num_faces(tmp_path / "mesh.ply") == len(mesh.faces)
    header = "ply\nformat binary_big_endian 1.0\nelement vertex 40\n" + "".join(f"property double {n}\n" for n in "xyz")
    (tmp_path / "big.ply").write_bytes(header.encode() + b"end_header\n" + points.astype(">f8").tobytes())
    found = read_vertices(tmp_path / "big.ply")
    np.testing.assert_array_equal(np.stack([found[name] for name in "xyz"], 1), points)
    camera = "element camera 3\nproperty float f\nproperty uchar id\n"  # 15 bytes before the vertices
    header = header.replace("element vertex", f"{camera}element vertex")
    (tmp_path / "big.ply").write_bytes(header.encode() + b"end_header\n" + bytes(15) + points.astype(">f8").tobytes())
    found = read_vertices(tmp_path / "big.ply")
    np.testing.assert_array_equal(np.stack([found[name] for name in "xyz"], 1), points)


def test_every_cut_of_a_file_and_every_byte_too_many_is_noticed(written):
    """Open3D filled what was missing with zeros or leftover memory: an accuracy of .51 m in place of .08 m."""
    whole = written.read_bytes()
    for length in range(0, len(whole), 7):
        written.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"a\.ply"):
            read_cloud(written, 8)
    written.write_bytes(whole + b"\0")
    with pytest.raises(ValueError, match=r"1081 bytes after its header, which announces 1080 \(40 × vertex\)"):
        read_cloud(written, 8)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (b"property float z\n", b"property float height\n", "no element vertex with the properties x, y and z"),
        (b"element vertex 40", b"element vertex 999999999999", "announces 26999999999973"),
        (b"element vertex 40", b"element vertex -40", "line 3: 'element vertex -40' is no line"),
        (b"property float z\n", b"property float y\n", "line 6: 'property float y' is no line"),
        (b"property float z\n", b"property half z\n", "line 6: 'property half z' is no line"),
        (b"element vertex 40\n", b"element vertex 40\nelement vertex 40\n", "line 4: 'element vertex 40' is no line"),
        (b"property uchar red\n", b"property list uchar uchar x\n", "line 10: 'property list uchar uchar x' is no"),
        (b"property uchar red\n", b"property list uchar red\n", "line 10: 'property list uchar red' is no line"),
        (b"format binary_little_endian 1.0\n", b"", "does not say its format"),
        (b"property uchar red\n", b"property list uchar uchar red\n", "a list among or before its vertices"),
        (b"end_header\n", b"", "no end_header: it is truncated"),
        (b"ply\n", b"plx\n", "is no PLY file"),
    ],
)
def test_a_header_that_is_wrong_is_named(written, before, after, message):
    header, body = body_of(written)
    assert before in header
    written.write_bytes(header.replace(before, after) + body)
    with pytest.raises(ValueError, match=rf"a\.ply.*{message}"):
        read_vertices(written)


def text_of(kind, *rows):
    header = f"ply\nformat ascii 1.0\nelement vertex {min(len(rows), 2)}\n"
    return header + "".join(f"property {kind} {name}\n" for name in "xyz") + "end_header\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (text_of("float", "1 2 3", "4 5 6").replace("\n4 5 6", ""), "1 rows after its header, which announces 2"),
        (text_of("float", "1 2 3", "4 5"), "vertex 1 .* expected 3 numbers, got '4 5'"),
        (text_of("float", "1 2 3", "4 5 x"), "vertex 1 .* got '4 5 x'"),
        (text_of("float", "1 2 3", "4 5 6", "7 8 9"), "3 rows after its header, which announces 2"),
        # These were cut to whole numbers, or to 8 bits, and scored.
        (text_of("int", "1 2.5 3"), "vertex 0 .*: y is 2.5 and not int32, as the header says"),
        (text_of("uchar", "1 2 nan"), "z is nan and not uint8"),
        (text_of("uchar", "1 2 -5"), "z is -5 and not uint8"),
        (text_of("float", "1 2 1e30"), "has a point 1e.30 m away"),
    ],
)
def test_rows_of_text_are_counted_and_numbers_that_are_not_of_their_kind_or_no_lengths_are_named(
    tmp_path, text, message
):
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(ValueError, match=rf"a\.ply.*{message}"):
        read_cloud(tmp_path / "a.ply", 3)


def test_normals_that_are_not_finite_and_a_count_of_thousands_of_digits_are_named(tmp_path, points):
    normals = -points
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 40\n"
    header += "".join(f"property double {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    normals[3, 1] = np.nan
    rows = np.concatenate([points, normals], 1)
    (tmp_path / "a.ply").write_bytes(header.encode() + b"end_header\n" + rows.tobytes())
    with pytest.raises(ValueError, match="1 of 40 points are not finite in nx, ny, nz"):
        read_cloud(tmp_path / "a.ply", 8)
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex {'9' * 6000}\nend_header\n")
    with pytest.raises(ValueError, match=r"a\.ply, line 3: .* is no line of a PLY header"):
        read_vertices(tmp_path / "a.ply")
