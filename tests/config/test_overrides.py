"""What people call their files, for Hydra's grammar; oracle: what Hydra makes of the word."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.config.overrides import parsed, quoted, readable

NAMES = (
    *(
        "IMG (1).mp4",
        "Küche",
        "名前",
        "a=b",
        "[loft]/x",
        "it's",
        'a "b"',
        "C:\\Users\\me\\walk",
        "end\\",
        "a'b\\'c",
        "100%",
    ),
    *("a b", "#1", "{x", "a&b;c", "2024", "007", "1e3", "true", "null", "~/walk", "glob*", "x:y", "naïve, Räume"),
)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_read_as_it_stands_whatever_signs_it_has(name):
    (word,) = readable([f"dataset.root={name}"])
    meant = name.replace("~", str(Path.home()))
    assert parsed(word).value() == meant or (name == "null" and parsed(word).value() is None)
    assert readable([word]) == [word] and parsed(f"x={quoted(name)}").value() == name
    if name in ("IMG (1).mp4", "2024"):
        assert compose("dataset=images", f"dataset.root={name}").dataset.root == name


@pytest.mark.parametrize("name", ["walk, kitchen", "[loft]", "a,b"])
def test_what_is_there_is_meant_even_where_it_could_be_a_list(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    word = f"prior.folder={name}"
    before = parsed(readable([word])[0]).value()
    (tmp_path / name).mkdir()
    assert before != name and parsed(readable([word])[0]).value() == name


@pytest.mark.parametrize("key", ["graph.noise.map", "prior.seed", "dataset.stride", "slam.fit.min_std"])
def test_a_number_stays_one_whatever_its_key_ends_with_and_whatever_folders_there_are(key, tmp_path, monkeypatch):
    """Symptom: `graph.noise.map=0.3` was text, and so was any number beside a folder of that name, as COLMAP's `1`."""
    monkeypatch.chdir(tmp_path)
    for value in ("1", "0.25"):
        (tmp_path / value).mkdir()
        assert OmegaConf.select(compose("graph=default", f"{key}={value}"), key) == float(value)
    for name in ("map", "out", "dataset.sequence", "dataset.model", "prior.folder"):
        assert parsed(readable([f"{name}=1"])[0]).value() == "1"


def test_items_of_a_list_are_text_where_need_be():
    assert parsed(readable(["text=[Stühle,Tisch (rund), wall]"])[0]).value() == ["Stühle", "Tisch (rund)", "wall"]


def test_what_hydra_reads_stays_as_it_is():
    words = ["+a=1", "++a.b=[x,y]", "~a", "slam/em=paper", "a='x y'", "x=range(1,4)", "a=null", "seeds=[0,1]", "a=${b}"]
    assert readable(words) == words


def test_the_home_is_written_out_in_every_key_and_choice():
    """`trajectory=~/path.txt` of a zsh did not exist, although it did."""
    home = str(Path.home())
    assert parsed(readable(["trajectory=~/a b.txt"])[0]).value() == f"{home}/a b.txt"
    assert readable(["map=~/a,~/b"]) == [f"map={home}/a,{home}/b"]
    assert readable(["map=[~/a,~/b]", "map=[~/a, ~/b]"]) == [f"map=[{home}/a,{home}/b]", f"map=[{home}/a, {home}/b]"]
    assert parsed(readable(["map=a~/b"])[0]).value() == "a~/b" and readable(["~features"]) == ["~features"]
