"""The commands of the package: `emgs run dataset=…`; `emgs --help` lists them."""

import re
import sys
from collections.abc import Callable
from importlib import import_module

from .console import speak_on
from .interrupt import clear_interrupt

GROUPS = {
    "make a map": ("run", "ros", "merge", "predict"),
    "look at it": ("view", "report", "polish", "export"),
    "ask it": ("query", "embed"),
    "measure": ("evaluate", "score", "segment"),
}
COMMANDS = tuple(name for names in GROUPS.values() for name in names)


def usage() -> str:
    """Describe each command by a line and an example, in groups."""
    lines = ["usage: emgs COMMAND [key=value …]"]
    for group, names in GROUPS.items():
        lines += ["", f"{group}:"]
        for name in names:
            lines += [f"  {name:10} {words}" for name, words in zip((name, ""), beginning_of(name), strict=True)]
    lines += ["", "emgs COMMAND --help lists what can be chosen, emgs COMMAND --cfg job every key with its value."]
    return "\n".join(lines)


def beginning_of(name: str) -> tuple[str, str]:
    """A command's purpose and an example, from the first lines of its file in conf/."""
    from .command import CONF, RUN

    text = (CONF / f"{RUN if name == 'run' else name}.yaml").read_text(encoding="utf-8")
    purpose, example = re.match(rf"# emgs {name}: (.*?)\.(?: .*)?\n# ( .*)", text).groups()
    return purpose, example


def explained(name: str) -> Callable[[], None]:
    """Make a program that shows a command's help without its imports."""
    from .command import RUN, command

    return command(RUN if name == "run" else name)(lambda config: None)


def main() -> None:
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
