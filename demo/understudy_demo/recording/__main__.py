"""The command behind scripts/record."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from pathlib import Path

from understudy_demo.__main__ import Progress
from understudy_demo.kubectl import CommandFailed, Kubectl, run
from understudy_demo.play import NAMESPACE, ROBOT, WORKLOAD, NotSo, Play
from understudy_demo.recording.asciicast import Cast, from_text, to_text
from understudy_demo.recording.panes import NotShown, Pane, Split
from understudy_demo.recording.svg import HOLD, render
from understudy_demo.recovery import Recovered
from understudy_demo.stage import BUILT, REPOSITORY, Stage

CAST = REPOSITORY / "docs" / "images" / "failover.cast"
SVG = CAST.with_suffix(".svg")

TITLE = "An application that drives a robot is killed, and then freezes: its understudy takes over each time"
COLUMNS = 100
STATUS, AT_ROBOT, SHELL = range(3)
PANES = (
    Pane("understudy status -w", ["understudy", "status", "-w"], rows=14),
    Pane(
        "at the robot: each | is a command that reached it",
        ["sh", "-c", f"kubectl logs -f --tail=0 {ROBOT} | marks"],
        rows=6,
    ),
    Pane("a shell", ["bash", "--norc", "--noprofile", "--noediting", "-i"], rows=18, typed=True),
)
PROMPT = "$ "

LONGEST = 30.0
"""Seconds of it that anybody looks at; where the machine is busy with other things, it takes longer."""


def main(arguments: list[str] | None = None) -> int:
    """Record, or only draw what was recorded."""
    parser = argparse.ArgumentParser(prog="scripts/record", add_help=False)
    parser.add_argument("--render", action="store_true")
    parser.add_argument("--provider", choices=["kind", "local", "current"])
    parser.add_argument("--images")
    options = parser.parse_args(arguments)
    if not options.render:
        say = Progress()
        try:
            stage = Stage(options.provider, say, registry=options.images)
            cast = _recorded(stage, options.images or BUILT, say)
        except (CommandFailed, NotSo, NotShown) as error:
            say(f"FAILED: {error}")
            say("what was set up stays, and scripts/record begins again")
            return 1
        CAST.write_text(to_text(cast))
    SVG.write_text(render(from_text(CAST.read_text())))
    print(f"{SVG.relative_to(REPOSITORY)}, drawn from {CAST.relative_to(REPOSITORY)}")
    return 0


def _recorded(stage: Stage, images: str, say: Progress) -> Cast:
    """Set up what the demo sets up, and record two failures of it."""
    stage.cluster()
    stage.images()
    stage.chart()
    kubectl = Kubectl(NAMESPACE, stage.environment)
    play = Play(kubectl, say, images=images)
    play.clear()
    play.begin("executing")
    kubectl("label", "namespace", NAMESPACE, "understudy.dev/allow-inject=true")
    play.prepare("executing")
    with tempfile.TemporaryDirectory() as folder, Split(PANES, COLUMNS, _environment(stage, Path(folder))) as split:
        say("recording")
        act(split)
        cast = split.cast(TITLE)
    say(f"recorded {cast.length:.1f} s")
    recoveries = [Recovered.read(entry) for entry in kubectl.get("robotworkload", WORKLOAD)["status"]["recoveries"]]
    log = play.log()
    problems = [f"{len(recoveries)} recoveries where 2 were expected"] if len(recoveries) != 2 else []
    problems += [f"it is longer than {LONGEST:g} s: is the machine busy?"] if cast.length > LONGEST else []
    for recovered in recoveries:
        problems += recovered.problems(recovered.handover(log), strategy="Fallback/Executing")
    if problems:
        raise NotSo("; ".join(problems))
    play.clear()
    stage.remove()
    return cast


def act(split: Split) -> None:
    """What is done while it is recorded. All that is waited for is what is shown."""
    split.until(lambda: _is_calm(split) and "|" in split.text(AT_ROBOT), within=60)
    split.wait(1.0)
    split.begin()
    split.wait(1.5)
    _fail(split, "kill")
    split.until(lambda: _is_calm(split), within=120)  # the next understudy stands ready
    split.wait(0.5)
    _fail(split, "freeze --for 1s")
    split.wait(0.5)
    split.type(f"understudy timeline {WORKLOAD} --last 1")
    split.until(lambda: "moments" in split.text(SHELL) and _is_prompted(split), within=30)
    split.until(lambda: _is_calm(split), within=120)
    split.wait(HOLD / 5)


def _fail(split: Split, how: str) -> None:
    """Wait until another pod drives and the status reports it."""
    before = _driver(split)
    split.type(f"understudy inject {WORKLOAD} {how} --yes")
    split.until(lambda: _driver(split) not in ("", before), within=60)
    split.until(lambda: _driver(split) in split.text(STATUS) and _is_prompted(split), within=30)


def _driver(split: Split) -> str:
    """Whose commands reach the robot, by the ending of its name."""
    return split.text(AT_ROBOT).strip().rpartition("\n")[2].partition(" ")[0]


def _is_calm(split: Split) -> bool:
    return "1 robot: all protected; 1 healthy" in split.text(STATUS) and _is_prompted(split)


def _is_prompted(split: Split) -> bool:
    return split.text(SHELL).rstrip().endswith(f"\n{PROMPT.strip()}") or split.text(SHELL).strip() == PROMPT.strip()


def _environment(stage: Stage, folder: Path) -> dict[str, str]:
    """That of the panes: with the commands by the names that they have where they are installed, and the namespace set."""
    for name, module in (("understudy", "understudy"), ("marks", "understudy_demo.recording.marks")):
        program = folder / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {module} "$@"\n')
        program.chmod(0o755)
    kubeconfig = folder / "kubeconfig"
    shutil.copyfile(stage.environment["KUBECONFIG"], kubeconfig)
    environment = {
        **stage.environment,
        "KUBECONFIG": str(kubeconfig),
        "PATH": f"{folder}{os.pathsep}{stage.environment['PATH']}",
        "PS1": PROMPT,
    }
    for unwanted in ("COLUMNS", "LINES", "NO_COLOR", "PROMPT_COMMAND"):
        environment.pop(unwanted, None)
    run(["kubectl", "config", "set-context", "--current", "--namespace", NAMESPACE], environment)
    return environment


if __name__ == "__main__":
    sys.exit(main())
