"""The commands of the package: `emgs run dataset=…`; `emgs --help` lists them."""

import sys
from collections.abc import Callable
from importlib import import_module

from .console import speak_on
from .interrupt import clear_interrupt

COMMANDS = {  # name: (what it does, an example)
    "run": ("map a video, a folder of images or a data set", "emgs run video.mp4"),
    "evaluate": ("data sets × sequences × variants × seeds, with one table", "emgs evaluate suite=smoke seeds=[0,1,2]"),
    "score": ("any other system under the same protocol", "emgs score trajectory=poses.txt method=peer dataset=tum …"),
    "sweep": ("a grid of settings on one sequence", "emgs sweep sweep=gates experiment=smoke"),
    "tune": ("a search for better settings", "emgs tune tune=gates experiment=smoke 'held_out={other:{prior.seed:3}}'"),
    "effects": ("what each value of sweeps changes", "emgs effects folder=multirun/sweep"),
    "report": ("write the page of a finished run anew", "emgs report outputs/synthetic/2026-01-31_12-00-00"),
    "polish": (
        "sharp splats fitted to the images of a finished run",
        "emgs polish outputs/synthetic/2026-01-31_12-00-00",
    ),
    "view": ("look at a finished run in the browser", "emgs view outputs/synthetic/2026-01-31_12-00-00"),
    "export": ("a run for COLMAP, nerfstudio and others", "emgs export outputs/… 'formats=[colmap,frustums]'"),
    "predict": ("record what a prior says of a sequence", "emgs predict dataset=… prior=mapanything out=predictions"),
    "embed": ("class names to text features", "emgs embed features=dinov3_text 'classes=[wall,floor]' out=text.npz"),
    "query": ("ask a finished map for things", "emgs query map=outputs/monday 'text=[chair,table]'"),
    "segment": ("segmentation of finished maps, as the paper's Table III", "emgs segment 'map=[outputs/office0]' …"),
    "tables": ("the tables of README.md, from one commit", "emgs tables root=data"),
    "benchmark": ("how long the stages take", "emgs benchmark 'parts=[stages,icp]'"),
}


def usage() -> str:
    """One line and an example for each command."""
    lines = ["usage: emgs COMMAND [key=value …]", "", "commands:"]
    for name, (purpose, example) in COMMANDS.items():
        lines += [f"  {name:10} {purpose}", f"  {'':10}   {example}"]
    lines += ["", "emgs COMMAND --help lists what can be chosen, emgs COMMAND --cfg job every key with its value."]
    return "\n".join(lines)


def explained(name: str) -> Callable[[], None]:
    """Return a program that shows the help of a command without its imports."""
    from .command import RUN, command

    return command(RUN if name == "run" else name)(lambda config: None)


def main() -> None:
    """Hand the rest of the command line to a command."""
    speak_on()
    name, *rest = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help", "help"):
        print(usage())
    elif name == "--version":
        print(import_module("emgs_jax").__version__)
    elif name not in COMMANDS:
        raise SystemExit(f"error: {name} is no command of emgs: choose one of {', '.join(COMMANDS)}")
    else:
        sys.argv = [f"emgs {name}", *rest]
        with clear_interrupt():  # the imports take seconds
            (explained(name) if {"-h", "--help"} & {*rest} else import_module(f".{name}", __package__).main)()


if __name__ == "__main__":
    main()
