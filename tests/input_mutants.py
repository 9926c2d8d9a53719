"""Plausible bugs of what stands between a run and its inputs: files of others, values of the config."""

from mutant import Mutant

PLY_READER = ("tests/io/test_ply_reader.py",)
FILES = ("tests/io/test_files.py",)
RUN_FILES = ("tests/report/test_run_files.py",)
RESULTS = ("tests/report/test_results.py",)
NPZ = ("tests/io/test_npz.py",)
MAP_FILE = ("tests/io/test_map_file.py",)
RECORDED = ("tests/prior/test_recorded.py",)
READABLE = ("tests/data/test_readable.py",)
READING = ("tests/data/test_reading.py",)
TUM = ("tests/data/test_tum.py",)
CHECKSUMS = ("tests/data/test_checksums.py",)
VALUES = ("tests/running/test_values.py",)
ROSBAG = ("tests/data/test_rosbag.py",)
POSED = ("tests/data/test_posed_images.py",)
VIEWER = ("tests/report/test_viewer.py",)
LIVE = ("tests/report/test_live.py",)
SCALING = ("tests/report/test_scaling.py",)
EXPORT = ("tests/report/test_export.py",)

MUTANTS = (
    Mutant(
        "emgs_jax/data/rosbag.py",
        "K[0]), float(K[4]), float(K[2])",
        "K[0]), float(K[4]), float(K[3])",
        ROSBAG,
        "the centre of a bag's camera is another entry of its matrix",
    ),
    Mutant(
        "emgs_jax/data/rosbag.py",
        "reshape(message.height, message.step)[:, :width]",
        "reshape(message.height, message.step)[:, -width:]",
        ROSBAG,
        "what fills a row up is taken for picture",
    ),
    Mutant(
        "emgs_jax/report/viewer_layers.py",
        "for rows in (wanted, against)),",
        "for rows in (wanted, against[:0])),",
        VIEWER,
        "words that are not asked for change nothing",
    ),
    Mutant(
        "emgs_jax/report/viewer_layers.py",
        "is_met = (along > 0) & ",
        "is_met = ",
        VIEWER,
        "a click tells of what is behind the camera",
    ),
    Mutant(
        "emgs_jax/report/viewer.py",
        'return "Words of this run: " + escape(", ".join(self._names))',
        'return "Words of this run: " + ", ".join(self._names)',
        VIEWER,
        "names from a file are markup in the browser",
    ),
    Mutant(
        "emgs_jax/report/viewer.py",
        'HOST = "127.0.0.1"',
        'HOST = "0.0.0.0"',
        ("tests/report/test_live_browser.py",),
        "a run that is watched can be watched from the network",
    ),
    Mutant(
        "experiments/command.py",
        "body = [*chosen, *(line",
        "body = [*(line",
        ("tests/scripts/test_command_line.py",),
        "the help of a command leaves out what has to be chosen",
    ),
    Mutant(
        "emgs_jax/report/live.py",
        "time.monotonic() >= self._due and self._is_idle()",
        "time.monotonic() >= self._due",
        LIVE,
        "pictures queue up behind one that takes long",
    ),
    Mutant(
        "emgs_jax/report/live.py",
        "end + max(self._every_s, (end - begin) / SHARE)",
        "end",
        LIVE,
        "a run is drawn all the time",
    ),
    Mutant(
        "emgs_jax/report/viewer.py",
        "            if is_last:",
        "            if run.frames:",
        LIVE,
        "who looks at an earlier frame is taken to the last",
    ),
    Mutant(
        "emgs_jax/report/scaling.py",
        "np.float32(factor**2)",
        "np.float32(factor)",
        SCALING,
        "covariances grow as lengths do",
    ),
    Mutant(
        "emgs_jax/io/ply_reader.py",
        "rows[name] += math.log(factor)",
        "rows[name] *= factor",
        SCALING,
        "logarithms of standard deviations are multiplied",
    ),
    Mutant(
        "emgs_jax/report/scaling.py",
        """if frame["index"] == number]""",
        "if row == number]",
        SCALING,
        "frames are counted without those that were left out",
    ),
    Mutant(
        "emgs_jax/data/colmap_model.py",
        "Rotation.from_quat(values[[1, 2, 3, 0]])",
        "Rotation.from_quat(values[:4])",
        POSED,
        "COLMAP's quaternions, w first, are read as w last",
    ),
    Mutant(
        "emgs_jax/data/posed_images.py",
        "times = times_of([solved.images[row] for row in order])",
        "times = times_of(solved.images)",
        POSED,
        "times are those of the order in the file",
    ),
    Mutant(
        "emgs_jax/data/transforms_json.py",
        "np.vstack([m, bottom])) * FLIP)",
        "np.vstack([m, bottom])))",
        POSED,
        "nerfstudio's axes are taken for OpenCV's",
    ),
    Mutant(
        "emgs_jax/io/colmap.py",
        "_words((fx, fy, cx + 0.5, cy + 0.5))",
        "_words((fx, fy, cx, cy))",
        EXPORT,
        "COLMAP's principal point is half a pixel off",
    ),
    Mutant(
        "emgs_jax/io/nerfstudio.py",
        "poses = np.asarray(T_world_camera, np.float64) * FLIP",
        "poses = np.asarray(T_world_camera, np.float64)",
        EXPORT,
        "nerfstudio's cameras look backwards",
    ),
    Mutant(
        "emgs_jax/report/recorded_run.py",
        """np.array([frame["status"] != "lost" for frame in self.frames], bool)""",
        "np.ones(len(self.frames), bool)",
        EXPORT,
        "guessed poses of lost frames are exported as good ones",
    ),
    Mutant(
        "emgs_jax/report/recorded_run.py",
        """known = metrics["provenance"]["data"]["frames"]""",
        """known = metrics["provenance"]["data"]["camera"]""",
        EXPORT,
        "the camera of a run is that of the images on disk",
    ),
    Mutant(
        "emgs_jax/data/checksums.py",
        "if self._sound.get(place) == version:",
        "if place in self._sound:",
        CHECKSUMS,
        "what was sound once is sound for ever",
    ),
    Mutant(
        "emgs_jax/data/checksums.py",
        "found[_place(path.parent / name)]",
        "found[_place(Path(name))]",
        CHECKSUMS,
        "names are looked up where the program runs",
    ),
    Mutant(
        "emgs_jax/data/checksums.py",
        "    if missing:\n",
        "    if len(missing) == len(images):\n",
        CHECKSUMS,
        "a list that was cut off checks some images only",
    ),
    Mutant(
        "emgs_jax/data/readable.py",
        "_unreadable(self._read, progress(indices))",
        "_unreadable(dataset.__getitem__, progress(indices))",
        CHECKSUMS,
        "a changed frame ends a run that leaves out bad ones",
    ),
    Mutant(
        "emgs_jax/io/ply_reader.py",
        " and name not in [other.name for other in elements]",
        "",
        PLY_READER,
        "a file has its vertices twice",
    ),
    Mutant(
        "emgs_jax/running/values.py",
        "if isinstance(value, DictConfig) and not is_plain:",
        "if isinstance(value, DictConfig):",
        VALUES,
        "an empty mapping stands for a number",
    ),
    Mutant(
        "emgs_jax/io/ply_reader.py",
        "if num_bytes < expected or (num_bytes > expected and not is_open):",
        "if num_bytes > expected and not is_open:",
        PLY_READER,
        "a truncated cloud is read",
    ),
    Mutant(
        "emgs_jax/io/ply_reader.py",
        "if len(lines) != expected:",
        "if len(lines) > expected:",
        PLY_READER,
        "a truncated text is read",
    ),
    Mutant(
        "emgs_jax/io/ply_reader.py",
        '{"x", "y", "z"} <= element.properties.keys()',
        '{"x", "y"} <= element.properties.keys()',
        PLY_READER,
        "a cloud without heights passes the header",
    ),
    Mutant(
        "emgs_jax/io/ply_reader.py",
        "_row_type(vertex, order), vertex.count",
        '_row_type(vertex, "<"), vertex.count',
        PLY_READER,
        "the big end last",
    ),
    Mutant(
        "emgs_jax/running/values.py",
        "math.isfinite(value) if ends is None else ends.low <= value <= ends.high",
        "ends is None or ends.low <= value <= ends.high",
        VALUES,
        "nan passes where a field has no range",
    ),
    Mutant(
        "emgs_jax/running/values.py",
        "else ends.low <= value <= ends.high",
        "else not (value < ends.low or value > ends.high)",
        VALUES,
        "nan is in every range",
    ),
    Mutant(
        "emgs_jax/running/values.py",
        "        key = found[1]\n",
        "        return key\n",
        VALUES,
        "the key that refers to a value is named, which cannot be set",
    ),
    Mutant(
        "emgs_jax/running/configure.py",
        "    check_values(config, key)\n",
        "",
        VALUES,
        "nothing is checked",
    ),
    Mutant(
        "emgs_jax/data/readable.py",
        "        _check_truth(dataset, self.kept)\n",
        "",
        READABLE,
        "a bad true pose is found when its frame comes up",
    ),
    Mutant(
        "emgs_jax/data/reading.py",
        "if np.abs(position).max() > MAX_POSITION_M:",
        "if position.max() > MAX_POSITION_M:",
        READING,
        "geo-referenced west of the origin",
    ),
    Mutant(
        "emgs_jax/data/tum.py",
        "[numbers[i] for i in order]",
        "numbers",
        TUM,
        "the line of another pose where the times are out of order",
    ),
    Mutant(
        "emgs_jax/data/tum.py",
        "    if max(rows) < 0:",
        "    if max(rows) < -1:",
        TUM,
        "a list that matches nothing is ground truth",
    ),
    Mutant(
        "emgs_jax/report/run_files.py",
        "            path.replace(target / path.name)\n",
        "            path.unlink()\n",
        RUN_FILES,
        "the outputs of an earlier run are deleted",
    ),
    Mutant(
        "emgs_jax/report/run_files.py",
        "for name in OUTPUTS if (folder / name).exists()]",
        "for name in OUTPUTS[1:] if (folder / name).exists()]",
        RUN_FILES,
        "old metrics stay beside a new trajectory",
    ),
    Mutant(
        "emgs_jax/io/files.py",
        "if name and not _is_running(int(name[1]))]",
        "if name]",
        FILES,
        "a file that is being written is removed",
    ),
    Mutant(
        "emgs_jax/report/results.py",
        ' or part in (".", "..")',
        "",
        RESULTS,
        "a variant of two dots",
    ),
    Mutant(
        "emgs_jax/io/npz.py",
        "num_bytes != len(data) - handle.tell()",
        "num_bytes < len(data) - handle.tell()",
        NPZ,
        "memory is taken for what a header announces",
    ),
    Mutant(
        "emgs_jax/io/map_file.py",
        "jnp.isfinite(leaf[valid])",
        "jnp.isfinite(leaf)",
        MAP_FILE,
        "what stands in free rows matters",
    ),
    Mutant(
        "emgs_jax/io/map_file.py",
        "if (leaf.shape, leaf.dtype) != (like.shape, like.dtype):",
        "if leaf.shape != like.shape:",
        MAP_FILE,
        "a map of small integers",
    ),
    Mutant(
        "emgs_jax/prior/recorded.py",
        "        check_numbers(self.folder / name, arrays)\n",
        "",
        RECORDED,
        "forged numbers are replayed",
    ),
    Mutant(
        "emgs_jax/prior/recorded_checks.py",
        "    poses = poses[np.isfinite(poses).all((1, 2))]\n",
        "",
        RECORDED,
        "a view without a pose is a fault",
    ),
)
