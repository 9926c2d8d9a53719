"""What the command line says: the choices in its help, and one line with the remedy for a word that is wrong."""

import contextlib
import gc
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import hydra
import jax
import pytest
from hydra.types import RunMode
from omegaconf import OmegaConf
from own_process import run
from tiny_run import CONF
from tqdm import tqdm

from emgs_jax.config.configure import compose, groups
from emgs_jax.config.overrides import parsed, readable
from emgs_jax.io.files import owned
from emgs_jax.sequence import load_config
from experiments.cli import COMMANDS, main
from experiments.command import (
    check_arguments,
    check_missing,
    check_out,
    first_words,
    kept_words,
    leave_float32,
    nothing_left,
)
from experiments.console import speak_on
from experiments.evaluate import delegated
from experiments.interrupt import clear_interrupt

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["graph=default", "graph.agreement.max_contradicted=1"],
            r" is called graph\.consistency\.max_violating_queries now",
        ),
        (["slam/continuation=paper"], r"^slam/continuation is called slam/extrapolation now"),
        (["slam.em.max_mahalanobis=3"], r"is no key of the config; near names: slam\.em\.max_mahalanobis_sq"),
        (["slam.refinement.render.opacity=0.3"], r"near names: .*\brender\.opacity"),
        (["dataset=tum", "dataset.num_frames=3"], r"dataset\.num_frames is no key of the config"),
        (["prior.nothing=2"], r"near names: prior\.version, prior\.classes, prior\.confusion, prior\.feature_size"),
        (["view=bright"], "view=bright is no option of view: there are live, none"),
        (["slam=paper"], r"slam is chosen by its parts: slam/em=…, slam/existence=…, slam/extrapolation=…"),
        (["dataset=scannetpp"], "dataset=scannetpp is no option of dataset: there are apartment, bonn, camera, colmap"),
        (["dataset=1.5"], "^dataset=1.5 is no option of dataset: there are apartment"),
        (["dataset=null"], "^dataset=null: Config group override must be a string"),
        (["graph=3"], "^graph=3 is no option of graph: there are default, none"),
        (["slam.em=null"], r"^slam\.em=None would replace all of its keys: .* with slam/em=default$"),
        (["hydra=3"], "^hydra=3: "),
    ],
)
def test_an_override_that_names_nothing_is_one_line_with_what_was_perhaps_meant(overrides, message):
    with pytest.raises(ValueError, match=message) as caught:
        compose(*overrides)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("word", "near"),
    [
        ("+foo=1", "near names: "),
        ("++foo=1", "near names: "),
        ("+featurs.text=a", "near names: .*features"),
        ("+features.txt=a", "near names: features.text"),
        ("+graph.max_known=1", "near names: "),
        ("+slam.window_sizes=3", "near names: slam.window_size"),
        ("+slam.em.nosie=3", r"near names: slam\.em\.noise"),
        ("+densify.render.opacty=.3", r"near names: .*render\.opacity"),
        ("+map.foo=1", "near names: "),
    ],
)
def test_a_key_that_is_added_and_that_nobody_reads_is_refused(word, near):
    """Symptom: `emgs run +foo=1` was taken without a word."""
    with pytest.raises(
        ValueError, match=rf"^{re.escape(word)} would have no effect: .* is no key of the config; {near}"
    ):
        check_arguments("config", [word])
    with pytest.raises(ValueError, match="would have no effect"):
        load_config(word)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("config", ["prior=multiview_stereo", "+prior.structure.options.extraction.max_num_features=99"]),
        ("config", ["++slam.em.noise=.1"]),
        ("config", ["+hydra.job.name=x"]),
        ("config", ["+baseline.mine={_target_:x}"]),
        ("evaluate", ["suite=smoke", "+variants.wide={slam.window_size:7}"]),
        ("evaluate", ["suite=smoke", "+tolerances.x={direction:lower,tolerance:.1}"]),
    ],
)
def test_a_key_that_is_added_where_any_name_may_stand_is_taken(name, words):
    check_arguments(name, words)


def test_a_word_in_the_place_of_a_group_is_an_error_for_every_group():
    """It was a string in the place of a stage's config."""
    parts = [group for group in groups() if "/" in group]
    assert len(parts) > 5
    for group in parts:
        with pytest.raises(ValueError, match=f"{group}=({'|'.join(groups()[group])})$"):
            compose("prior=multiview_stereo", f"{group.replace('/', '.')}={groups()[group][0]}")


FOLDER = r"hydra\.run\.dir=.*: .*file is no folder that can be written to"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("-m slam.em.nose=0,1", r"slam\.em\.nose is no key"),
        ("--cfg job slam.em.nose=0,1", r"slam\.em\.nose is no key"),
        ("dataset.root=my folder", "is no KEY=VALUE: put a value with spaces into quotes.*emgs run --help"),
        ("dataset=images stop -m", "is no KEY=VALUE"),
        ("hydra.run.dir=file", FOLDER),
        ("hydra.run.dir=file/run", FOLDER),
        ("--config-dir nowhere", "--config-dir nowhere is no folder"),
        ("--config-dir own dataset=mine dataset.nothing=other", "is no key of the config"),
        ("-m slam.em.noise=0,1 prior=simulated,multiview_stereo hydra.run.dir=x", None),
        ("--cfg job --package slam ~hydra.run -m", None),
        ("hydra.run.dir=new/run hydra.job.name=${out}", None),
        ("--config-dir own dataset=mine dataset.root=other", None),
        ("--config-dir=own dataset=mine", None),
        ("-cd own dataset=mine", None),
    ],
)
def test_words_are_checked_before_anything_begins_and_what_is_hydras_is_left_to_it(
    words, message, tmp_path, monkeypatch
):
    """Of a folder that cannot be made Hydra tells by a traceback."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "own" / "dataset").mkdir(parents=True)
    (tmp_path / "own" / "dataset" / "mine.yaml").write_text("_target_: emgs_jax.data.images.Images\nroot: walk\n")
    with pytest.raises(ValueError, match=message) if message else contextlib.nullcontext():
        check_arguments("config", words.split())


def said_by(monkeypatch, capsys, *words: str) -> str:
    """What `emgs WORDS` prints."""
    monkeypatch.setattr(sys, "argv", ["emgs", *words])
    with contextlib.suppress(SystemExit):  # Hydra's help ends the program
        main()
    return capsys.readouterr().out


def test_the_help_of_a_run_lists_exactly_the_choices_that_there_are(monkeypatch, capsys):
    said, own = said_by(monkeypatch, capsys, "run", "--help"), groups()
    lines = {name: words for name, words in re.findall(r"^  ([\w/]+)= +(.*)$", said, re.MULTILINE)}
    listed = {
        name: sorted(word.strip() for word in re.split("[;:]", re.sub(r"\([^)]*\)", "", words))[0].split(","))
        for name, words in lines.items()
        if name in own
    }
    of_other_commands = {"densify_on", "experiment_on", "suite"}
    stages = {name for name in own if name.startswith("slam/")}
    assert listed == {name: own[name] for name in {*own} - of_other_commands - stages | {"slam/em"}}
    assert {*re.findall(r"slam/\w+", lines["slam/em"]), "slam/em"} == stages


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ("run", "ros")])
def test_the_help_of_a_command_names_its_keys_and_its_examples_are_ones(name, monkeypatch, capsys):
    """Oracles: what a YAML reader finds in its file, and Hydra, which takes the examples as they are typed."""
    said = said_by(monkeypatch, capsys, name, "nowhere", "port=0", "--help")  # and nothing else is read
    assert said.startswith(f"emgs {name}: ")
    known = OmegaConf.load(CONF / f"{name}.yaml")
    choices = [key for choice in known.pop("defaults") if OmegaConf.is_config(choice) for key in choice]
    keys = {*known, *(key for key in choices if not key.startswith("override "))} - {"hydra"}
    assert keys and all(re.search(rf"^{key}:", said, re.MULTILINE) for key in keys)
    assert not any(str(path) in said for path in (CONF.parent, Path.home(), Path(sys.prefix)))
    examples = [shlex.split(line) for line in said.splitlines() if line.startswith(f"  emgs {name} ")]
    assert len(examples) >= 2
    merged = first_words("folders", is_list=True)
    rewritten = {"evaluate": delegated, "merge": merged}.get(name, first_words("folder"))
    for _, _, *words in examples:
        check_arguments(name, rewritten(words))


def test_a_console_without_a_sign_shows_another_and_goes_on(monkeypatch):
    """Where the locale is not UTF-8 the "…" after the mapping ended the run."""
    console = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", console)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    speak_on()
    print("writing …", flush=True)
    assert console.buffer.getvalue() == b"writing ?\n"


def test_a_program_whose_reader_has_gone_works_on(monkeypatch):
    """`emgs run … | head` ended with "Broken pipe" when all was mapped, and nothing of it was written."""
    for name in ("stdout", "stderr"):
        reading, writing = os.pipe()
        os.close(reading)
        monkeypatch.setattr(sys, name, os.fdopen(writing, "w", buffering=1))
    speak_on()
    for _ in range(3):
        print("a line", flush=True)
        tqdm.write("another one")
        print("an error", file=sys.stderr)
    sys.stdout.close()
    sys.stderr.close()


@pytest.mark.parametrize("error", [SystemExit("error: no such file"), ZeroDivisionError("division by zero"), None])
def test_the_log_of_a_job_has_the_consoles_words_and_how_it_failed(error, tmp_path, capsys):
    logging = OmegaConf.create({"handlers": {"file": {"filename": str(tmp_path / "run.log")}}})
    with pytest.raises(type(error)) if error else contextlib.nullcontext(), kept_words(logging):
        print("Wände")
        tqdm.write("a line")
        if error:
            raise error
    assert capsys.readouterr().out == "Wände\na line\n"
    first, second, *rest = (tmp_path / "run.log").read_text(encoding="utf-8").splitlines()
    assert (first, second) == ("Wände", "a line") and bool(rest) == bool(error)
    assert not error or str(error) in rest[-1]
    with kept_words(OmegaConf.create({"handlers": {"console": {}}})):
        print("nowhere")
    assert capsys.readouterr().out == "nowhere\n" and {path.name for path in tmp_path.iterdir()} == {"run.log"}


HELPS = """
import contextlib, io, sys
from experiments.cli import COMMANDS, main
for words in ([], ["--version"], *([name, "--help"] for name in COMMANDS)):
    sys.argv = ["emgs", *words]
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        main()
    heavy = {"jax", "open3d", "torch", "matplotlib", "scipy", "trimesh", "equinox", "viser"} & {*sys.modules}
    print(*words, len(said.getvalue()), sorted(heavy), file=sys.stderr)
"""


def test_no_help_imports_what_computes():
    """All commands in one process of their own; `import open3d` alone is 2.3 s."""
    done = subprocess.run([sys.executable, "-c", HELPS], cwd=CONF.parent, capture_output=True, text=True, check=True)
    lines = done.stderr.splitlines()
    assert len(lines) == 2 + len(COMMANDS) and [line for line in lines if not line.endswith(" []")] == []


def test_what_has_to_be_given_is_named_with_the_command_or_its_options():
    for name in ("view", "report", "export"):
        with pytest.raises(ValueError, match=f"^folder is not given .*: emgs {name} folder=…$"):
            check_missing(name, compose(name=name))
    check_missing("view", compose("folder=x", name="view"))
    with pytest.raises(ValueError, match="^features is not given: choose features= one of dinov2_text, dinov3_text"):
        compose(name="embed")


def test_a_folder_with_any_signs_is_the_first_word():
    for name in ("/runs/Küche (1), [a=b]", "it's", "outputs/a b"):
        (word, *rest) = readable(first_words("folder")(readable([name, "port=1"])))
        assert parsed(word).key_or_group == "folder" and parsed(word).value() == name and rest == ["port=1"]
    for words in (["folder=x"], ["-m"], []):
        assert first_words("folder")(words) == words == first_words("folders", is_list=True)(words)
    assert first_words("folders", is_list=True)(["a", "b", "x=1"]) == ["folders=['a','b']", "x=1"]


def test_an_output_that_cannot_be_written_is_named_before_the_work(tmp_path):
    """`emgs score … out=FILE` and `emgs predict` on a disk that is read-only said it after all of the work."""
    (tmp_path / "file").write_text("")
    for out in ("file", "file/below", "file/text.npz"):
        with pytest.raises(ValueError, match=f"^out=.*{out}: .*file is no folder that can be written to"):
            check_out(OmegaConf.create({"out": str(tmp_path / out)}))
    for out in (None, "???", str(tmp_path / "new" / "folder"), str(tmp_path / "text.npz"), "relative"):
        check_out(OmegaConf.create({"out": out}))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_command_that_comes_to_nothing_leaves_nothing(tmp_path, monkeypatch):
    """Neither the folder that Hydra made nor those above it, up to where the user is."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "outputs" / "synthetic" / "now"
    monkeypatch.setattr("experiments.command.HydraConfig", SimpleNamespace(get=lambda: hydra_of(folder)))
    for kept in (None, "frames.jsonl"):
        (folder / ".hydra").mkdir(parents=True)
        (folder / "run.log").touch()
        with pytest.raises(ValueError, match="wrong"), nothing_left():
            if kept:
                (folder / kept).touch()
            raise ValueError("wrong")
        assert tmp_path.exists() and folder.exists() == (kept is not None)
        assert [path.name for path in tmp_path.iterdir()] == (["outputs"] if kept else [])


def test_numbers_of_64_bits_are_turned_off_and_that_is_said(monkeypatch, capsys):
    """JAX_ENABLE_X64=1, set for another program, ended a run after its first frame."""
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    jax.config.update("jax_enable_x64", True)
    try:
        leave_float32()
        assert not jax.config.jax_enable_x64
    finally:
        jax.config.update("jax_enable_x64", False)
    assert capsys.readouterr().out.startswith("JAX_ENABLE_X64 is set, and is of no effect")
    monkeypatch.setenv("JAX_ENABLE_X64", "0")
    leave_float32()
    assert not capsys.readouterr().out


@pytest.mark.parametrize("own", ["notes.log", "session.log/frames.csv", "run.log", "held", None])
@pytest.mark.parametrize("has_log", [True, False])
def test_a_command_that_comes_to_nothing_removes_nothing_that_was_there(own, has_log, tmp_path, monkeypatch):
    """`emgs report typo` in a folder of logs removed it with all of them, an empty one where the user stood, and a run
    of the same second the folder of the one before, which held it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("experiments.command.HydraConfig", SimpleNamespace(get=lambda: hydra_of(tmp_path, has_log)))
    if has_log:
        (tmp_path / "run.log").touch()
    if own not in ("held", None):
        (tmp_path / own).parent.mkdir(exist_ok=True)
        (tmp_path / own).write_text("mine")
    before = {path: path.is_file() and path.read_text() for path in tmp_path.rglob("*")}
    holder, message = (owned(tmp_path), "another program") if own == "held" else (contextlib.nullcontext(), "wrong")
    with holder, pytest.raises(ValueError, match=message), nothing_left(), owned(tmp_path):
        raise ValueError("wrong")
    assert tmp_path.is_dir()
    assert own is None or before == {path: path.is_file() and path.read_text() for path in tmp_path.rglob("*")}


def hydra_of(folder: Path, has_log: bool = True) -> SimpleNamespace:
    """What Hydra says of a run."""
    handlers = {"file": {"filename": str(folder / "run.log")}} if has_log else {"console": {}}
    logging = OmegaConf.create({"handlers": handlers})
    return SimpleNamespace(runtime=SimpleNamespace(output_dir=str(folder)), mode=RunMode.RUN, job_logging=logging)


def test_a_name_with_any_signs_is_read_and_a_run_of_nothing_leaves_nothing(tmp_path):
    folder = tmp_path / "my runs" / "first"
    done = run("experiments.run", "dataset=images", "dataset.root=Küche (1)", f"hydra.run.dir={folder}")
    assert done.returncode == 1 and done.stderr.startswith("error: dataset.root=Küche (1) does not exist")
    assert "Traceback" not in done.stderr and not folder.exists()


class Going:
    """An object that does something while it goes."""

    def __init__(self, last: Callable[[], None]) -> None:
        self.last = last

    def __del__(self) -> None:
        self.last()


@contextlib.contextmanager
def heard():
    """Ctrl-C as in a terminal: what is started in the background of a script has it ignored, tests too."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class Key:
    """What a weak reference may be of."""


class Iterating(set):
    """In the place of the iterators over a weak dictionary, which it looks at as it takes a key out."""

    def __init__(self, send) -> None:
        super().__init__()
        self._send = send

    def __bool__(self) -> bool:
        self._send()
        return False


def raises(code: int) -> None:
    raise SystemExit(code)


WORDS = {signal.SIGTERM: "terminated\n", signal.SIGINT: "interrupted\n"}


@pytest.mark.parametrize("number", WORDS)
@pytest.mark.parametrize("place", ["collector", "object", "weak reference", "program", "imports"])
def test_a_signal_ends_a_command_with_one_word_wherever_the_program_is(number, place, monkeypatch, capfd):
    """Python prints what is raised in a callback of the collector, as JAX has one, and the run went on to its end."""
    sent = []

    def send(*_):
        if not sent:
            sent.append(number)
            os.kill(os.getpid(), number)
            sum(range(10))  # the handler runs here

    before = [signal.getsignal(one) for one in WORDS]
    monkeypatch.setattr(os, "_exit", raises)
    monkeypatch.setattr(sys, "argv", ["emgs", "run", "dataset=nowhere"])
    monkeypatch.setattr("experiments.cli.import_module", send)
    if place == "collector":
        gc.callbacks.append(send)
    with heard(), pytest.raises(SystemExit) as ended, clear_interrupt():
        match place:
            case "collector":
                while not sent:  # nothing happens while another thread collects
                    gc.collect()
            case "object":
                Going(send)
            case "weak reference":  # which a dictionary takes out; the key's last use is here
                kept = weakref.WeakKeyDictionary()
                kept._iterating = Iterating(send)
                kept[key := Key()] = None
                del key
            case "program":
                send()
            case "imports":
                main()
        threading.Event().wait(5)
    gc.callbacks[:] = [one for one in gc.callbacks if one is not send]
    assert (ended.value.code, capfd.readouterr().err) == (128 + number, WORDS[number])
    assert [signal.getsignal(one) for one in WORDS] == before


KEPT = """import atexit, os, threading, time, numpy as np
from scipy.spatial import cKDTree
from experiments.interrupt import clear_interrupt
atexit.register(os.write, 1, b'Python ends')
with clear_interrupt():
 print('kept', end='')
"""
PROGRAMS = {  # with threads that Python does not wait for as it ends, or does; and one that has done its work
    "daemons of SciPy": f"""{KEPT} tree = cKDTree(np.random.default_rng(0).random((400000, 3)))
 os.write(1, b'begun\\n')
 while True: tree.query(tree.data + .01, workers=2)
""",
    "threads that are waited for": f"""{KEPT} os.write(1, b'begun\\n')
 thread = threading.Thread(target=time.sleep, args=(90,))
 thread.start()
 while True: thread.join(.1)  # a signal just before one long wait is heard when that is over
""",
    "an end": """import atexit, time
from experiments.interrupt import clear_interrupt, end_clearly
end_clearly()
with clear_interrupt(): print('kept', end='')
def end():
 print('begun', flush=True)
 for _ in range(900): time.sleep(.1)
atexit.register(end)
""",
}


@pytest.mark.parametrize("kind", PROGRAMS)
def test_a_signal_ends_the_program_whatever_it_does(kind):
    """The kills found SIGSEGV, one time in fifty: Python ends, and what a thread computes with is gone before it; and a
    traceback of JAX's clean up, in a callback that Python calls as it ends."""
    number = signal.SIGTERM if kind == "an end" else signal.SIGINT
    with begun(PROGRAMS[kind]) as (process, first):
        process.send_signal(number)
        assert (process.wait(60), process.stderr.read().decode()) == (128 + number, WORDS[number])
        assert first + process.stdout.read() in (b"keptbegun\n", b"begun\nkept")


@contextlib.contextmanager
def begun(program: str):
    """A program that has begun, and its first line, which says so."""
    command = [sys.executable, "-c", program]
    with heard():
        process = subprocess.Popen(command, cwd=CONF.parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    with process:
        first = process.stdout.readline()
        assert first.endswith(b"begun\n")
        yield process, first


def test_a_signal_while_a_command_imports_ends_it_with_a_word():
    """Found by the kills: `python -m experiments.run` showed where in a library's import it was."""
    command = [sys.executable, "-X", "importtime", "-m", "experiments.run"]
    with heard():
        process = subprocess.Popen(command, cwd=CONF.parent, stderr=subprocess.PIPE, text=True)
    with process:
        for line in process.stderr:
            if line.split()[-1] == "experiments":  # is imported, and listens; its commands are not
                break
        process.send_signal(signal.SIGTERM)
        said = [line for line in process.stderr.read().splitlines() if not line.startswith("import time:")]
        assert (process.wait(60), said) == (143, ["terminated"])


def test_a_signal_that_is_ignored_stays_so():
    """As of a job in the background of a script."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with clear_interrupt():
            os.kill(os.getpid(), signal.SIGINT)
            sum(range(10))
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_folder_of_several_runs_is_known_before_the_first():
    """`emgs run -m prior.seed=0,1` ended with "HydraConfig was not set": Hydra asks for it before there is a job."""
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF.resolve())):
        config = hydra.compose("config", return_hydra_config=True)
    assert re.fullmatch(r"multirun/synthetic/[\d_-]+", config.hydra.sweep.dir)
