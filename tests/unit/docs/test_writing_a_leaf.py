"""A leaf of one's own: the page's package is installed for real, and every command has its leaf."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.bag_recording import every, write
from tests.support.golden import assert_golden

REPOSITORY = Path(__file__).parents[3]
PAGE = (REPOSITORY / "docs" / "how-to" / "writing-a-leaf.md").read_text()
SCAN = "sensor_msgs/msg/LaserScan"


def fenced(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


MODULE, TEST = fenced("python")
(POLICY,) = fenced("yaml")
PROJECT: dict[str, Any] = tomllib.loads(fenced("toml")[0])["project"]


def install(folder: Path, module: str = MODULE) -> Path:
    """The page's package, from a wheel, in a folder of its own. (To have one built takes a package that pip would fetch.)"""
    name, version = PROJECT["name"].replace("-", "_"), PROJECT["version"]
    info = f"{name}-{version}.dist-info"
    groups = [
        [f"[{group}]", *(f"{a} = {b}" for a, b in entries.items())]
        for group, entries in PROJECT["entry-points"].items()
    ]
    files = {
        "acme_leaves.py": module,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {PROJECT['name']}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": "\n".join(line for group in groups for line in group),
    }
    wheel = folder / f"{name}-{version}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for path, text in files.items():
            archive.writestr(path, text)
        archive.writestr(f"{info}/RECORD", "".join(f"{path},,\n" for path in (*files, f"{info}/RECORD")))
    site = folder / "site"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-index",
        "--target",
        str(site),
        str(wheel),
    ]
    subprocess.run(pip, check=True, timeout=120)
    return site


def run(site: Path, *command: str, cwd: Path) -> tuple[int, str]:
    """A command's exit status and what it said, with what is installed in ``site``."""
    path = os.pathsep.join([str(site), str(REPOSITORY / "operator")])
    done = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=cwd, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install(tmp_path_factory.mktemp("acme"))


def policy(**monitoring: Any) -> str:
    item = yaml.safe_load(POLICY)
    item["spec"]["monitoring"] = monitoring
    return yaml.safe_dump(item)


def inline(start: str) -> str:
    """What the page writes in a line, in backticks."""
    (found,) = re.findall(rf"`({re.escape(start)}[^`]*)`", PAGE)
    return str(found)


XML = f'<root BTCPP_format="4"><BehaviorTree ID="Healthy">{inline("<AcmeLively ")}</BehaviorTree></root>'
OSC = f"import osc.understudy\n\nscenario healthy:\n    do parallel:\n        {inline('acme_lively(')}\n"


def test_the_documented_test_passes(site: Path, tmp_path: Path) -> None:
    (tmp_path / "test_leaves.py").write_text(TEST)
    status, output = run(site, "pytest", "-q", "-p", "no:cacheprovider", "test_leaves.py", cwd=tmp_path)
    assert (status, "1 passed" in output) == (0, True), output


@pytest.mark.parametrize("text", [POLICY, policy(xml=XML), policy(osc=OSC)], ids=["yaml", "xml", "osc"])
def test_a_policy_with_the_leaf_is_checked(site: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "policy.yaml").write_text(text)
    status, output = run(site, "understudy", "check", "--strict", "policy.yaml", cwd=tmp_path)
    assert status == 0, output
    wrong = text.replace("1s", "1 parsec").replace("field", "fjeld")
    (tmp_path / "policy.yaml").write_text(wrong)
    status, output = run(site, "understudy", "check", "policy.yaml", cwd=tmp_path)
    assert status == 1
    assert "parsec" in output


def test_without_the_package_the_leaf_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "policy.yaml").write_text(POLICY)
    status, output = run(tmp_path, "understudy", "check", "policy.yaml", cwd=tmp_path)
    assert status == 1
    assert "unknown key 'acme_lively'" in output


def test_repeated_scans_are_found_in_a_bag(site: Path, tmp_path: Path) -> None:
    (tmp_path / "policy.yaml").write_text(POLICY)
    scans = [one._replace(fields={"ranges": [min(one.at, 5.0), 2.0]}) for one in every("/scan", SCAN, 0, 8, 10)]
    write(tmp_path / "recorded", scans)
    status, output = run(site, "understudy", "simulate", "policy.yaml", "--bag", "recorded", cwd=tmp_path)
    assert status == 1, output
    assert_golden("simulate", output, "acme_lively must accept", "1 s", "ranges")
    assert "1x, 1.8 s, first at 6.100 s  Failed" in output


def test_a_package_that_cannot_be_imported_is_reported_at_its_leaf(tmp_path: Path) -> None:
    site = install(tmp_path, "import acme_drivers\n")
    why = (
        "acme_lively of acme-leaves 1.0 cannot be used: acme_leaves:Lively cannot be loaded, "
        "ModuleNotFoundError: No module named 'acme_drivers'"
    )
    (tmp_path / "policy.yaml").write_text(POLICY)
    status, output = run(site, "understudy", "check", "policy.yaml", cwd=tmp_path)
    assert (status, output.count(why)) == (1, 2), "once as it is loaded, once at its place in the file"
    assert (
        f"policy.yaml:9:11: error: FailurePolicy navigation: spec.monitoring.yaml.parallel[1].acme_lively: {why}"
        in output
    )
    for text in (policy(xml=XML), policy(osc=OSC)):
        (tmp_path / "policy.yaml").write_text(text)
        assert run(site, "understudy", "check", "policy.yaml", cwd=tmp_path)[1].count(why) == 2
    (tmp_path / "policy.yaml").write_text(policy(yaml={"topic": {"name": "/scan", "gap": "1s"}}))
    status, output = run(site, "understudy", "check", "policy.yaml", cwd=tmp_path)
    assert (status, output.count(why)) == (0, 1), "trees that don't name it are as good as ever"


def test_the_documented_chart_values_exist() -> None:
    values = yaml.safe_load((REPOSITORY / "charts" / "understudy" / "values.yaml").read_text())
    documented = re.findall(r"--set (\S+)=", PAGE)
    assert len(documented) == 4
    for key in documented:
        found = values
        for part in key.split("."):
            found = found[part]


def test_installed_leaves_do_not_change_generated_files(site: Path) -> None:
    program = (
        "from scripts.generation.scenarios import library\nfrom pathlib import Path\n"
        "assert library() == Path('operator/understudy/trees/languages/osc/lib_osc/understudy.osc').read_text()\n"
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(site), str(REPOSITORY / "operator"), str(REPOSITORY)]),
    }
    subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, env=environment, check=True, timeout=120)
