"""Plausible bugs of what stands between a run and its inputs: files of others, values of the config."""

from mutant import Mutant

PLY_READER = ("tests/io/test_ply_reader.py",)
VALUES = ("tests/running/test_values.py",)

MUTANTS = (
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
)
