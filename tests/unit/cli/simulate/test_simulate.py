"""The command: what it prints, what it draws, how it ends, and what it says of what it can't use."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from PIL import Image, ImageColor
from rosbags.rosbag2 import Writer

from tests.support.bag_recording import RecordedMessage, every, ns, policy, write
from tests.support.golden import assert_golden
from understudy.cli.common import palette
from understudy.cli.simulate import plots
from understudy.cli.simulate.simulate import main

TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With a bag in which /cmd_vel is silent from 2.9 s on, for 2.1 s."""
    monkeypatch.chdir(tmp_path)
    messages = [
        *every("/cmd_vel", TWIST, 0, 3, 10),
        *every("/cmd_vel", TWIST, 5, 8, 10),
        *every("/odom", TWIST, 0, 8, 10),
    ]
    write(tmp_path / "bag", messages)
    (tmp_path / "policy.yaml").write_text(policy("{topic: {name: /cmd_vel, gap: 500ms}}"))
    (tmp_path / "patient.yaml").write_text(policy("{topic: {name: /cmd_vel, gap: 3s}}"))
    return tmp_path


def test_detections_are_printed_with_their_times_and_the_exit_status_is_1(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["policy.yaml", "--bag", "bag"]) == 1
    captured = capsys.readouterr()
    assert captured.err == ""
    assert_golden(
        "simulate",
        captured.out,
        "(UTC)",
        "3.400 s",
        "2026-05-28 20:26:43",
        "cmd_vel",
        "2.900 s",
        "5.000 s",
        "/cmd_vel",
        "500 ms",
        "60",
        "7.468 Hz",
        "2.1 s",
        "1.6 s",
    )


def test_the_exit_status_is_0_without_detections(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["patient.yaml", "--bag", "bag"]) == 0
    assert "\nNothing was detected.\n" in capsys.readouterr().out


def test_a_single_file_of_a_bag_is_accepted(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["policy.yaml", "--bag", "bag/bag.mcap"]) == 1
    write(folder / "lite", every("/cmd_vel", TWIST, 0, 3, 10), "sqlite3")
    assert main(["policy.yaml", "--bag", "lite/lite.db3"]) == 0


def test_json_output_contains_the_detections(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["policy.yaml", "--bag", "bag", "-o", "json", "--onset", "2.95"]) == 1
    output = json.loads(capsys.readouterr().out)
    assert output["bag"] == {
        "path": "bag",
        "start": "2026-05-28T20:26:40.000Z",
        "startUnix": 1780000000.0,
        "duration": 7.9,
        "topics": 2,
    }
    assert output["detections"] == [
        {
            "detectedAt": 3.4,
            "detectedWall": "2026-05-28T20:26:43.400Z",
            "failedAt": 3.4,
            "lastWellAt": 2.9,
            "recoveredAt": 5.0,
            "leaf": "cmd_vel",
            "reason": "no /cmd_vel for 500 ms",
        }
    ]
    assert output["onsets"] == [{"at": 2.95, "delay": 0.45}]
    (leaf,) = output["leaves"]
    assert [state["state"] for state in leaf["states"]] == ["Healthy", "Failed", "Healthy"]
    assert main(["policy.yaml", "--bag", "bag", "-o", "yaml", "--onset", "2.95"]) == 1
    assert yaml.safe_load(capsys.readouterr().out) == output


@pytest.mark.parametrize(
    ("onsets", "message"),
    [
        (["3"], "Given failure at 3.000 s: detected 400 ms later\n"),
        (["2026-05-28T20:26:43Z"], "Given failure at 3.000 s: detected 400 ms later\n"),
        (["1", "3s"], "Given failure at 1.000 s: NOT DETECTED\nGiven failure at 3.000 s: detected 400 ms later\n"),
        (["6"], "Given failure at 6.000 s: NOT DETECTED\nDetected at 3.400 s: matches no given failure\n"),
    ],
)
def test_given_onsets_are_printed_next_to_their_detections(
    folder: Path, capsys: pytest.CaptureFixture[str], onsets: list[str], message: str
) -> None:
    assert main(["policy.yaml", "--bag", "bag", *(part for one in onsets for part in ("--onset", one))]) == 1
    assert message in capsys.readouterr().out


def test_the_grace_option_replaces_the_grace_time_of_the_policy(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(folder / "late", [*every("/odom", TWIST, 0, 8, 10), *every("/cmd_vel", TWIST, 4, 8, 10)])
    assert main(["policy.yaml", "--bag", "late"]) == 0
    assert main(["policy.yaml", "--bag", "late", "--grace", "0s"]) == 1
    assert "no /cmd_vel within 0 ms of the start" in capsys.readouterr().out


def test_the_plot_shows_detections_and_failed_times(folder: Path) -> None:
    assert main(["policy.yaml", "--bag", "bag", "--plot", "drawn.png"]) == 1
    assert main(["patient.yaml", "--bag", "bag", "--plot", "fine.png"]) == 0
    line, lane, healthy = (
        ImageColor.getrgb(colour) for colour in (palette.LIMIT, plots.COLOURS["Failed"], plots.COLOURS["Healthy"])
    )
    for file, failed in (("drawn.png", True), ("fine.png", False)):
        colours = {colour for _, colour in Image.open(file).convert("RGB").getcolors(1 << 24) or ()}
        assert ({line, lane} <= colours) == failed
        assert healthy in colours, "healthy it was too"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["policy.yaml", "--bag", "bag", "--grace", "3"], "--grace: '3' is not a duration: write a number with ms"),
        (["none.yaml", "--bag", "bag"], "none.yaml: No such file or directory; give a file with a FailurePolicy"),
        (
            ["policy.yaml", "--bag", "none"],
            "none: no such file or folder; give a rosbag2 folder, or an .mcap or .db3",
        ),
        (
            ["policy.yaml", "--bag", "policy.yaml"],
            "policy.yaml: this cannot be read as a bag: Unrecognized storage format '.yaml'; its name",
        ),
        (["policy.yaml", "--bag", "."], "this cannot be read as a bag: "),
        (["policy.yaml", "--bag", "no.mcap"], "no.mcap: this cannot be read as a bag: File magic is invalid; give"),
        (
            ["policy.yaml", "--bag", "no.db3"],
            "no.db3: this cannot be read as a bag: Cannot open database no.db3: file is not a database; rosbag2 did not write it",
        ),
        (["policy.yaml", "--bag", "cut.mcap"], "repair an incomplete recording with `mcap recover`"),
        (
            ["policy.yaml", "--bag", "bag", "--onset", "soon"],
            "--onset: 'soon' is not a time: give seconds from the bag's start such",
        ),
        (["policy.yaml", "--bag", "bag", "--onset", "9"], "--onset: '9' is not within the bag, which is 7.900 s long"),
        (
            ["policy.yaml", "--bag", "bag", "--plot", "a.gif"],
            "--plot: found 'a.gif'; its name must end in .png, .svg, .pdf",
        ),
        (["policy.yaml", "--bag", "bag", "--plot", "no/a.png"], "--plot: the folder no does not exist; create it"),
        (
            ["policy.yaml", "--bag", "bag", "--policy", "tired"],
            "the file contains no FailurePolicy 'tired', did you mean 'tried'?",
        ),
        (
            ["pod.yaml", "--bag", "bag"],
            "pod.yaml: the file contains no FailurePolicy, found Pod web; give the file with",
        ),
        (["two.yaml", "--bag", "bag"], "two.yaml: the file contains 2 policies; choose one with --policy: one, two"),
        (
            ["treeless.yaml", "--bag", "bag"],
            "treeless.yaml:5:3: error: FailurePolicy tried: spec.monitoring.yaml: a health tree is required",
        ),
        (["broken.yaml", "--bag", "bag"], "broken.yaml:1:"),
        (["wrong.yaml", "--bag", "bag"], "spec.monitoring.yaml.topic.gap: found 500, which has no unit"),
        (
            ["typed.yaml", "--bag", "bag"],
            "the policy's tree has the type std_msgs/msg/Empty for /cmd_vel, but it was recorded as geometry",
        ),
        (["field.yaml", "--bag", "bag"], "geometry_msgs/msg/Twist has no field 'linnear', did you mean 'linear'?"),
    ],
)
def test_unusable_input_ends_with_status_2_and_a_cure(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    (folder / "no.mcap").write_bytes(b"not a recording at all, of whatever kind" * 9)
    (folder / "no.db3").write_bytes(b"not a recording at all, of whatever kind" * 9)
    (folder / "cut.mcap").write_bytes((folder / "bag" / "bag.mcap").read_bytes()[:-100])
    good = policy("{topic: {name: /cmd_vel, gap: 500ms}}")
    (folder / "pod.yaml").write_text("apiVersion: v1\nkind: Pod\nmetadata: {name: web}\n")
    (folder / "two.yaml").write_text("---\n".join(good.replace("tried", name) for name in ("one", "two")))
    (folder / "treeless.yaml").write_text(policy("null").replace("yaml: null", "").replace("30s, ", "30s"))
    (folder / "broken.yaml").write_text("a: [b")
    (folder / "wrong.yaml").write_text(good.replace("500ms", "500"))
    (folder / "typed.yaml").write_text(policy("{topic: {name: /cmd_vel, type: std_msgs/msg/Empty, gap: 500ms}}"))
    (folder / "field.yaml").write_text(policy(f'{{value: {{topic: /cmd_vel, type: {TWIST}, holds: "linnear.x > 0"}}}}'))
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("understudy simulate: ")
    assert message in printed.err


def test_an_option_selects_one_of_several_policies_by_name(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = [
        policy(f"{{topic: {{name: /cmd_vel, gap: {gap}}}}}", name=name)
        for name, gap in (("fast", "500ms"), ("slow", "3s"))
    ]
    (folder / "both.yaml").write_text("---\n".join(both))
    assert main(["both.yaml", "--bag", "bag", "--policy", "slow"]) == 0
    assert main(["both.yaml", "--bag", "bag", "--policy", "fast"]) == 1


def test_a_policy_in_xml_is_read_from_standard_input(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = '\'<root BTCPP_format="4"><BehaviorTree ID="Healthy"><Topic topic="/cmd_vel" gap="500ms"/></BehaviorTree></root>\''
    text = policy("null").replace("yaml: null", f"xml: {tree}")
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode())))
    assert main(["-", "--bag", "bag"]) == 1, capsys.readouterr().err
    assert "no /cmd_vel for 500 ms" in capsys.readouterr().out


REFERRING = """
apiVersion: understudy.dev/v1alpha1
kind: FailurePolicy
metadata: {name: tried}
spec:
  monitoring: {configMapKeyRef: {name: shared, key: cmd.yaml}}
  strategies: [{type: Restart}]
"""

LENDING = """
apiVersion: v1
kind: ConfigMap
metadata: {name: shared, labels: {understudy.dev/health-tree: "true"}}
data:
  cmd.yaml: |
    topic: {name: /cmd_vel, gap: 500ms}
"""


def test_a_tree_is_read_from_a_config_map_in_the_file_or_from_the_policy_status(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "both.yaml").write_text(f"{LENDING}---{REFERRING}")
    assert main(["both.yaml", "--bag", "bag"]) == 1
    status = "status: {tree: {name: shared, key: cmd.yaml, yaml: {topic: {name: /cmd_vel, gap: 3s}}}}\n"
    (folder / "printed.yaml").write_text(REFERRING + status)
    assert main(["printed.yaml", "--bag", "bag"]) == 0
    capsys.readouterr()
    (folder / "alone.yaml").write_text(REFERRING)
    assert main(["alone.yaml", "--bag", "bag"]) == 2
    assert_golden("simulate", capsys.readouterr().err, "failurepolicy/tried configmap/shared")
    (folder / "wrong.yaml").write_text(f"{LENDING.replace('500ms', '500')}---{REFERRING}")
    assert main(["wrong.yaml", "--bag", "bag"]) == 2
    assert "wrong.yaml:7:" in capsys.readouterr().err


def unknown(folder: Path) -> None:
    """A bag of a type that nobody has a definition of."""
    with Writer(folder / "own", version=9) as writer:
        connection = writer.add_connection("/arm", "acme_msgs/msg/Arm", msgdef="", rihs01="RIHS01_00")
        for at in range(5):
            writer.write(connection, ns(at), b"\0\1\0\0\1\0\0\0")


def test_messages_of_an_unknown_type_are_counted_but_not_decoded(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    unknown(folder)
    (folder / "count.yaml").write_text(policy("{topic: {name: /arm, gap: 500ms}}"))
    (folder / "look.yaml").write_text(policy('{value: {topic: /arm, type: acme_msgs/msg/Arm, holds: "joints > 3"}}'))
    assert main(["count.yaml", "--bag", "own"]) == 1
    assert main(["look.yaml", "--bag", "own"]) == 2
    assert_golden("simulate", capsys.readouterr().err, "acme_msgs", "/arm")


def test_message_definitions_in_the_bag_are_used(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Writer(folder / "own", version=9) as writer:
        connection = writer.add_connection("/arm", "acme_msgs/msg/Arm", msgdef="int32 joints\n", rihs01="RIHS01_00")
        for at, joints in enumerate((6, 6, 2)):
            writer.write(connection, ns(at), b"\0\1\0\0" + joints.to_bytes(4, "little"))
    (folder / "look.yaml").write_text(policy('{value: {topic: /arm, type: acme_msgs/msg/Arm, holds: "joints > 3"}}'))
    assert main(["look.yaml", "--bag", "own"]) == 1
    assert "/arm: joints was 2, but joints > 3 is required" in capsys.readouterr().out


def test_control_characters_in_messages_do_not_reach_the_terminal(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = {"status": [{"name": "camera", "level": 2, "message": "\x1b[2Jgone\x07"}]}
    write(folder / "bad", [RecordedMessage(0, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", status)])
    (folder / "d.yaml").write_text(policy("{diagnostics: {name: camera, worst: WARN}}", grace="0s"))
    assert main(["d.yaml", "--bag", "bad"]) == 1
    out = capsys.readouterr().out
    assert "gone" in out
    assert "\x1b" not in out
    assert "\x07" not in out


def run(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize(("missing", "extra"), [("rosbags", "bags"), ("matplotlib", "plots")])
def test_a_missing_extra_is_reported_by_name(folder: Path, missing: str, extra: str) -> None:
    program = (
        f"import sys; sys.modules['{missing}'] = sys.modules['rclpy'] = None;"
        "sys.argv = ['understudy', 'simulate', 'policy.yaml', '--bag', 'bag', '--plot', 'a.png'];"
        "from understudy.main import main; sys.exit(main())"
    )
    done = run(program, folder)
    assert done.returncode == 2, done.stderr
    assert f"pip install '.[{extra}]'" in done.stderr


def test_simulate_runs_as_a_subcommand_without_ros(folder: Path) -> None:
    program = (
        "import sys; sys.modules['rclpy'] = None; sys.argv = ['understudy', 'simulate', 'policy.yaml', '--bag', 'bag'];"
        "from understudy.main import main; sys.exit(main())"
    )
    done = run(program, folder)
    assert done.returncode == 1, done.stderr
    assert "no /cmd_vel for 500 ms" in done.stdout
